"""Objectives and rows that a user brings, as CasADi functions of the positions of an arm's nodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from vgtm_qp.arm.arm import Arm
from vgtm_qp.arrays import Array, Index
from vgtm_qp.errors import PartError, nearest

Nodes = Mapping[str, ca.SX]
"""The positions of an arm's nodes, (3, 1) symbols, m, by name."""

_GREATEST_WEIGHT = 1e12
_MARGIN = 1e-6
"""Value that the rows of a QP keep, so that the new state has at least 0."""
_TOLERANCE = 1e-9
"""Negative value of a row that counts as rounding."""


@dataclass(frozen=True)
class Objective:
    """A term of the null-space objective of each step: half the square of a residual after the step, times a weight.

    The residual is linearised in each QP, so that its curvature is that of Gauss and Newton.

    Attributes
    ----------
    name
        Its name in messages.
    residual
        Function of the nodes: a mapping of their names to their positions, symbols of CasADi (3, 1), m. It returns an
        expression, or a list of them. Nodes of a truss are its joints, of a serial arm the origins of its frames; both
        determine the configuration. ``vgtm_qp.Resolver(problem).setup.arm.node_names`` has the names.
    weight
        0 or more; beside those of ``[method.weights]``, by which node displacements in m^2 have the weight 1.
    unit
        Unit of the residual, for people to read.
    """

    name: str
    residual: Callable[[Nodes], Any]
    weight: float = 1.0
    unit: str = "m"


@dataclass(frozen=True)
class Inequality:
    """A row that every step keeps: a value that is 0 or more in each state.

    It is linearised in each QP, and computed again at the new state, which is refused if the value is below 0 (to
    1e-9). Between two states it is not proven, and no certificate is about it.

    Attributes
    ----------
    name
        Its name in messages, as ``row: NAME``.
    value
        Function of the nodes, as of :class:`Objective`: an expression of CasADi, or a list of them, each 0 or more;
        best of the size of lengths in metres.
    unit
        Unit of the value, for people to read.
    """

    name: str
    value: Callable[[Nodes], Any]
    unit: str = "m"


class OwnRows(NamedTuple):
    """Linearised rows over the displacements of some nodes: coefficients . d rho[nodes] >= lower.

    Attributes
    ----------
    nodes, coefficients, lower : (R, K) int, (R, K, 3), (R,)
        In the units of the rows, over m.
    """

    nodes: Index
    coefficients: Array
    lower: Array


class Curvature(NamedTuple):
    """A term of an objective over the displacements of free nodes: gradient (3 F,) and Hessian (3 F, 3 F)."""

    gradient: Array
    hessian: Array


class OwnTerms:
    """The objectives and rows of a user for one arm.

    Attributes
    ----------
    objectives, rows
        As they were given.
    units : dict of str to str
        Names of all rows, ``row: NAME``, and their units.

    Raises
    ------
    PartError
        A function has no finite value at home, knows other nodes, or returns something else than expressions; or a row
        is broken at home.
    """

    def __init__(
        self, arm: Arm, objectives: Sequence[Objective] = (), rows: Sequence[Inequality] = ()
    ) -> None:
        self.objectives, self.rows, self._arm = tuple(objectives), tuple(rows), arm
        for one in self.objectives:
            _check_objective(one)
        self._residuals = [
            _linear(arm, f'objective "{one.name}"', one.residual, float(np.sqrt(one.weight)))
            for one in self.objectives
        ]
        self._values = [_checked_row(arm, row) for row in self.rows]
        self.units: dict[str, str] = {}
        for row, linear in zip(self.rows, self._values, strict=True):
            numbers = [f" {k + 1}" for k in range(linear.size)] if linear.size > 1 else [""]
            self.units |= {f"row: {row.name}{number}": row.unit for number in numbers}
        used = [linear.nodes for linear in self._values]
        self._nodes = np.unique(np.concatenate(used)) if used else np.zeros(0, dtype=np.int64)

    def __bool__(self) -> bool:
        return bool(self.objectives or self.rows)

    def curvature(self, q: Array, base: Array, *, motion: bool) -> Curvature:
        """Return the objectives at a configuration whose nodes the base moves to `base` (N, 3), m.

        Without `motion` the gradient is zero, as that of all null-space terms in a correction.
        """
        arm, X = self._arm, self._arm.nodes(q)
        size = 3 * len(arm.free)
        moved = np.where(arm.base[:, None], base - X, 0.0).reshape(-1)
        free = (3 * arm.free[:, None] + np.arange(3)).reshape(-1)
        gradient, hessian = np.zeros(size), np.zeros((size, size))
        for linear in self._residuals:
            value, jacobian = linear.at(X)
            over_free = jacobian[:, free]
            hessian += over_free.T @ over_free
            if motion:
                gradient += over_free.T @ (value + jacobian @ moved)
        return Curvature(gradient, hessian)

    def linear_rows(self, q: Array, *, motion: bool) -> OwnRows:
        """Return the rows at a configuration; with `motion` a step from it need not gain more than a margin."""
        found = [linear.at(self._arm.nodes(q)) for linear in self._values]
        values = np.concatenate([value for value, _ in found])
        slopes = np.concatenate([jacobian for _, jacobian in found]).reshape(len(values), -1, 3)
        lower = _MARGIN - values
        return OwnRows(
            np.tile(self._nodes, (len(values), 1)),
            slopes[:, self._nodes],
            np.minimum(lower, 2.0 * _MARGIN) if motion else lower,
        )

    def values(self, q: Array) -> Array:
        """Return the values (R,) of all rows at a configuration."""
        return np.concatenate([linear.at(self._arm.nodes(q))[0] for linear in self._values])

    def hold(self, q: Array) -> bool:
        """Return whether all rows are kept at a configuration."""
        return bool(np.all(self.values(q) >= -_TOLERANCE))

    def record(self, configurations: Array) -> dict[str, Any]:
        """Return what a result tells of the terms: names, and of each row the least value in all states (T, ...)."""
        least = np.min([self.values(q) for q in configurations], axis=0) if self.rows else []
        return {
            "objectives": [{"name": o.name, "weight": o.weight, "unit": o.unit} for o in self.objectives],
            "rows": [
                {"name": name, "unit": unit, "least": float(value)}
                for (name, unit), value in zip(self.units.items(), least, strict=True)
            ],
        }


def _check_objective(one: Any) -> None:
    if not isinstance(one, Objective):
        raise PartError(f"{one!r} is no objective; expected vgtm_qp.Objective(name, residual)")
    weight: Any = one.weight
    if not (isinstance(weight, int | float) and 0.0 <= weight <= _GREATEST_WEIGHT):
        raise PartError(
            f'the objective "{one.name}" has the weight {one.weight!r}; expected a number from 0 to 1e12'
        )
    if not callable(one.residual):
        raise PartError(f'the objective "{one.name}" has the residual {one.residual!r}; expected a function')


class _ByName(dict[str, ca.SX]):
    """Nodes by name; an unknown name is an error that says which there are."""

    def __missing__(self, name: str) -> ca.SX:
        some = ", ".join(list(self)[:8]) + (", ..." if len(self) > 8 else "")
        raise PartError(f"no node is called {name!r}{nearest(str(name), self)}; nodes: {some}")


class _Linear(NamedTuple):
    """A function of node positions with its Jacobian; its number of values, and the nodes that it depends on."""

    function: ca.Function
    size: int
    nodes: Index

    def at(self, X: Array) -> tuple[Array, Array]:
        """Return values (R,) and Jacobian (R, 3 N) at node positions (N, 3), m."""
        value, jacobian = self.function(X.T)
        return np.array(value)[:, 0], np.array(jacobian)


def _linear(arm: Arm, what: str, function: Callable[[Nodes], Any], factor: float = 1.0) -> _Linear:
    X = ca.SX.sym("X", 3, len(arm.node_names))
    found = function(_ByName((name, X[:, k]) for k, name in enumerate(arm.node_names)))
    try:
        parts = found if isinstance(found, list | tuple) else [found]
        value = factor * ca.vertcat(*(ca.vec(ca.SX(part)) for part in parts))
    except (NotImplementedError, TypeError, RuntimeError):
        raise PartError(
            f"the {what} returned {type(found).__name__}; expected an expression of CasADi, or a list"
        ) from None
    if not value.numel():
        raise PartError(f"the {what} returned nothing; expected an expression of CasADi, or a list")
    jacobian = ca.jacobian(value, ca.vec(X))
    nodes = np.unique(np.array(jacobian.sparsity().get_col(), dtype=np.int64) // 3)
    linear = _Linear(ca.Function("own", [X], [ca.densify(value), ca.densify(jacobian)]), value.numel(), nodes)
    if not all(np.isfinite(part).all() for part in linear.at(arm.home)):
        raise PartError(f"the {what} has no finite value and slope at home")
    return linear


def _checked_row(arm: Arm, row: Any) -> _Linear:
    """Return the function of a row; PartError if it is none, or broken at home."""
    if not isinstance(row, Inequality):
        raise PartError(f"{row!r} is no row; expected vgtm_qp.Inequality(name, value)")
    if not callable(row.value):
        raise PartError(f'the row "{row.name}" has the value {row.value!r}; expected a function')
    linear = _linear(arm, f'row "{row.name}"', row.value)
    least = float(linear.at(arm.home)[0].min())
    if least < -_TOLERANCE:
        raise PartError(f'the row "{row.name}" is {least:.3g} {row.unit} at home; expected 0 or more')
    return linear
