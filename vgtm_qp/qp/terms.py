"""Objectives and rows that a user brings, as CasADi functions of the positions of an arm's nodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from vgtm_qp.arm.arm import Arm
from vgtm_qp.arrays import Array
from vgtm_qp.errors import PartError, nearest

Nodes = Mapping[str, ca.SX]
"""The positions of an arm's nodes, (3, 1) symbols, m, by name."""

_GREATEST_WEIGHT = 1e12


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


class Curvature(NamedTuple):
    """A term of an objective over the displacements of free nodes: gradient (3 F,) and Hessian (3 F, 3 F)."""

    gradient: Array
    hessian: Array


class OwnTerms:
    """The objectives of a user for one arm.

    Attributes
    ----------
    objectives
        As they were given.

    Raises
    ------
    PartError
        A function has no finite value at home, knows other nodes, or returns something else than expressions.
    """

    def __init__(self, arm: Arm, objectives: Sequence[Objective] = ()) -> None:
        self.objectives, self._arm = tuple(objectives), arm
        for one in self.objectives:
            _check_objective(one)
        self._residuals = [
            _linear(arm, f'objective "{one.name}"', one.residual, float(np.sqrt(one.weight)))
            for one in self.objectives
        ]

    def __bool__(self) -> bool:
        return bool(self.objectives)

    def curvature(self, q: Array, base: Array, *, motion: bool) -> Curvature:
        """Return the objectives at a configuration whose nodes the base moves to `base` (N, 3), m.

        Without `motion` the gradient is zero, as that of all null-space terms in a correction.
        """
        arm, X = self._arm, self._arm.nodes(q)
        size = 3 * len(arm.free)
        moved = np.where(arm.base[:, None], base - X, 0.0).reshape(-1)
        free = (3 * arm.free[:, None] + np.arange(3)).reshape(-1)
        gradient, hessian = np.zeros(size), np.zeros((size, size))
        for function in self._residuals:
            value, jacobian = (np.array(part) for part in function(X.T))
            over_free = jacobian[:, free]
            hessian += over_free.T @ over_free
            if motion:
                gradient += over_free.T @ (value[:, 0] + jacobian @ moved)
        return Curvature(gradient, hessian)


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


def _linear(arm: Arm, what: str, function: Callable[[Nodes], Any], factor: float = 1.0) -> ca.Function:
    """Return the function from node positions (3, N) to the values (R, 1) of a user's function and their Jacobian."""
    X = ca.SX.sym("X", 3, len(arm.node_names))
    found = function(_ByName((name, X[:, k]) for k, name in enumerate(arm.node_names)))
    try:
        parts = found if isinstance(found, list | tuple) else [found]
        value = ca.vertcat(*(ca.vec(ca.SX(part)) for part in parts))
    except (NotImplementedError, TypeError, RuntimeError):
        raise PartError(
            f"the {what} returned {type(found).__name__}; expected an expression of CasADi, or a list"
        ) from None
    if not value.numel():
        raise PartError(f"the {what} returned nothing; expected an expression of CasADi, or a list")
    value = factor * value
    linear = ca.Function("own", [X], [ca.densify(value), ca.densify(ca.jacobian(value, ca.vec(X)))])
    if not all(np.isfinite(np.array(part)).all() for part in linear(arm.home.T)):
        raise PartError(f"the {what} has no finite value and slope at home")
    return linear
