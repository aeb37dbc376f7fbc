"""A reference curve, sections 4.3-4.4: positions, frames, arc length and the Jacobian J_s of eq. (36)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from vgtm_qp.arrays import Array
from vgtm_qp.curve.families import CurveFamily, bernstein, within
from vgtm_qp.errors import CurveError
from vgtm_qp.rotation import rotation_from_vector, turn_between

_FRAME_STEPS_PER_CELL = 1
_NO_STEP = 1e-9
_NEWTON_STEPS = 100
_CONVERGED = 1e-13
_DIP, _GRADES = 0.1, 40
"""Share of the mean speed below which cells are graded towards the least speed; number of their halvings."""


@dataclass(frozen=True, eq=False)
class Curve:
    """A curve r(s) = sum w_i(s) p_i with a frame F(s) along it.

    Every method takes s of any shape, written (...), and gives arrays that begin with it. The columns of all
    Jacobians are the 3 V coordinates of p = col[p_i], eq. (33), then the T torsion coordinates: D = 3 V + T.

    Attributes
    ----------
    family : CurveFamily
        The weights w_i(s).
    control_vertices : (V, 3)
        p_i, m.
    torsion : (T,)
        tau_j, rad: the frame is turned about the tangent by tau(s) = sum b_j(s) tau_j, j = 1..T, with b_j the
        Bernstein polynomials of degree T. So tau(0) = 0, and tau(1) is the last coordinate.
    base_frame : (3, 3)
        Rotation whose third column is the base normal. F(0) is this frame, turned by the least rotation that
        brings its third column on the tangent; no rotation at all where the curve leaves along the normal.

    Raises
    ------
    CurveError
        Arrays of the wrong shape, or entries that are not numbers.
    """

    family: CurveFamily
    control_vertices: Array
    torsion: Array = field(default_factory=lambda: np.empty(0))
    base_frame: Array = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        shapes = {
            "control_vertices": (self.family.control_vertices, 3),
            "torsion": (np.size(self.torsion),),
            "base_frame": (3, 3),
        }
        for name, shape in shapes.items():
            array = np.asarray(getattr(self, name), dtype=float)
            if array.shape != shape or not np.all(np.isfinite(array)):
                raise CurveError(
                    f"{name} of this {self.family.name} must be finite numbers of the shape {shape}, not {array.shape}"
                )
            object.__setattr__(self, name, array)

    @property
    def coordinates(self) -> int:
        """Number D = 3 V + T of configuration variables, eq. (33)."""
        return self.control_vertices.size + self.torsion.size

    def position(self, s: ArrayLike) -> Array:
        """r(s), eq. (29), m: (..., 3)."""
        return self.derivative(s, 0)

    def derivative(self, s: ArrayLike, order: int = 1) -> Array:
        """Differentiate r by s, `order` times, m: (..., 3)."""
        return np.asarray(self.family.weights(s, order) @ self.control_vertices)

    def tangent(self, s: ArrayLike) -> Array:
        """t(s), the unit tangent: (..., 3); CurveError where r' vanishes."""
        return _unit(self.derivative(s, 1))

    def frame(self, s: ArrayLike) -> Array:
        """F(s): (..., 3, 3), columns x, y and the tangent, eq. (32).

        A rotation-minimising frame by double reflection (Wang et al., ACM Trans. Graphics 27, 2008; error of
        fourth order in the step), turned by tau(s) about the tangent. Straight parts and inflections are no
        singularities of it. CurveError where the family has kinks, r' vanishes, or the curve leaves against the base
        normal.
        """
        self._require_smooth()
        s = np.asarray(s, dtype=float)
        flat = np.clip(s.ravel(), 0.0, 1.0)
        grid = np.append(
            within(self.family.cells, np.arange(_FRAME_STEPS_PER_CELL) / _FRAME_STEPS_PER_CELL), 1.0
        )
        along = _running_products(self._double_reflections(grid[:-1], grid[1:]))
        step = np.clip(np.searchsorted(grid, flat, side="right") - 1, 0, len(grid) - 2)
        turn = self._double_reflections(grid[step], flat) @ along[step]
        angle = self._torsion_weights(flat) @ self.torsion
        normal, tangent = self.base_frame[:, 2], self.tangent(0.0)
        if float(normal @ tangent) < -1.0 + 1e-12:
            raise CurveError(
                "the curve leaves its base against the base normal, where its frame is not defined"
            )
        swing = rotation_from_vector(turn_between(normal, tangent))
        x, y, z = np.moveaxis(turn @ (swing @ self.base_frame), -1, 0)
        cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
        frames = np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=-1)
        return np.asarray(frames.reshape(*s.shape, 3, 3))

    def frame_rate(self, s: ArrayLike) -> Array:
        """Angular velocity of F along the curve, dF/ds = [w]x F, rad per unit of s: (..., 3)."""
        first, second = self.derivative(s, 1), self.derivative(s, 2)
        speed = np.linalg.norm(first, axis=-1, keepdims=True)
        twist = self._torsion_weights(s, 1) @ self.torsion
        return np.asarray(_curvature_binormal(first, second) * speed + twist[..., None] * _unit(first))

    def length(self, s: ArrayLike = 1.0) -> Array:
        """Arc length from 0 to s, m: (...)."""
        return self._from_cells(self._speed_of, s, self._lengths, (1,))

    @cached_property
    def _lengths(self) -> Array:
        return self._over_cells(self._speed_of, (1,))

    def _speed_of(self, w1: Array) -> Array:
        return np.asarray(np.linalg.norm(w1 @ self.control_vertices, axis=-1))

    def arc_parameter(self, fraction: ArrayLike) -> Array:
        """Parameters s at which these fractions, 0 to 1, of the whole arc length are reached: (...).

        Newton's method within the brackets of cells, with bisection wherever a step shrinks by less than half.
        CurveError where a fraction is outside 0 to 1 or not a number.
        """
        fraction = np.asarray(fraction, dtype=float)
        if not np.all((fraction >= 0.0) & (fraction <= 1.0)):
            raise CurveError("fractions of the arc length must be within 0 to 1")
        cells, lengths = self._cells, self._lengths
        goal = fraction.ravel() * lengths[-1]
        cell = np.clip(np.searchsorted(lengths, goal, side="right") - 1, 0, len(cells) - 2)
        low, high = cells[cell], cells[cell + 1]
        # The speed changes little within a cell.
        share = (goal - lengths[cell]) / np.maximum(lengths[cell + 1] - lengths[cell], np.finfo(float).tiny)
        s, step = low + np.clip(share, 0.0, 1.0) * (high - low), high - low
        for _ in range(_NEWTON_STEPS):
            excess, speed = self.length(s) - goal, np.linalg.norm(self.derivative(s), axis=-1)
            low, high = np.where(excess < 0, s, low), np.where(excess < 0, high, s)
            newton = np.clip(s - excess / np.maximum(speed, np.finfo(float).tiny), low, high)
            # A step as small as rounding must not lead to a bisection, which would throw the root back.
            is_slow = np.abs(newton - s) > np.maximum(step / 2, _CONVERGED)
            new = np.where(is_slow, (low + high) / 2, newton)
            step, s = np.abs(new - s), new
            if np.all(step <= _CONVERGED):
                break
        s = np.where(fraction.ravel() == 0.0, 0.0, np.where(fraction.ravel() == 1.0, 1.0, s))
        return np.asarray(s.reshape(fraction.shape))

    def position_jacobian(self, s: ArrayLike) -> Array:
        """dr/d(p, tau), eq. (36) for positions: (..., 3, D)."""
        return self._pad(_spread(self.family.weights(s)))

    def tangent_jacobian(self, s: ArrayLike) -> Array:
        """dt/d(p, tau) = (I - t t^T) / |r'| sum w_i' dp_i, 1/m: (..., 3, D)."""
        return self._pad(self._tangent_rows(self.family.weights(s, 1)))

    def orientation_jacobian(self, s: ArrayLike) -> Array:
        """Angular velocity of F(s) per rate of (p, tau), the lower rows of J_s: (..., 3, D).

        They are eq. (36) for orientations. Two components turn the tangent. The third, about it, is the torsion's
        rate less the integral of w_i' kappa b over 0 to s, kappa b = r' x r'' / |r'|^3, plus the contribution of the
        least rotation at the base if the curve leaves it off the normal.
        """
        self._require_smooth()
        s = np.asarray(s, dtype=float)
        tangent = self.tangent(s)
        turn = np.cross(
            tangent[..., None, :], np.swapaxes(self._tangent_rows(self.family.weights(s, 1)), -1, -2)
        )

        def roll_rate(w1: Array, w2: Array) -> Array:
            binormal = _curvature_binormal(w1 @ self.control_vertices, w2 @ self.control_vertices)
            return np.asarray(-w1[..., :, None] * binormal[..., None, :])

        # At s = 0 it rolls by the area that the arc from base normal to tangent sweeps.
        normal, base = self.base_frame[:, 2], self.tangent(0.0)
        swept = np.cross(base, normal) / (1.0 + normal @ base)
        roll = self._integral(roll_rate, s).reshape(*s.shape, -1)
        roll = roll + swept @ self._tangent_rows(self.family.weights(0.0, 1))
        rows = np.swapaxes(turn, -1, -2) + tangent[..., :, None] * roll[..., None, :]
        return np.concatenate([rows, tangent[..., :, None] * self._torsion_weights(s)[..., None, :]], axis=-1)

    def arc_node_rates(self, s: ArrayLike) -> Array:
        """ds/d(p, tau) of curve nodes that keep their fractions of the arc length, 1/m: (..., D).

        A node's whole rate is then (J_s + x' ds/dp) p-dot, with x' = (`derivative`, `frame_rate`); the
        paper's eq. (35) has the first term alone.
        """
        s = np.asarray(s, dtype=float)

        def stretch(w1: Array, _: Array) -> Array:
            return np.asarray(w1[..., :, None] * _unit(w1 @ self.control_vertices)[..., None, :])

        ends = np.append(s.ravel(), 1.0)
        gradient = self._integral(stretch, ends).reshape(ends.size, -1)
        lengths = self.length(ends)
        speed = np.linalg.norm(self.derivative(s.ravel(), 1), axis=-1)
        rates = ((lengths[:-1] / lengths[-1])[:, None] * gradient[-1] - gradient[:-1]) / speed[:, None]
        return self._pad(rates.reshape(*s.shape, -1))

    def _require_smooth(self) -> None:
        if not self.family.smooth:
            raise CurveError(
                f"this {self.family.name} of degree {self.family.degree} has kinks at knots of that "
                "multiplicity, and so no frame; choose a higher degree or repeat knots less often"
            )

    def _pad(self, rows: Array) -> Array:
        return np.concatenate([rows, np.zeros((*rows.shape[:-1], self.torsion.size))], axis=-1)

    def _tangent_rows(self, w1: Array) -> Array:
        """(..., 3, 3 V) rows of dt/dp from the table of w'."""
        first = w1 @ self.control_vertices
        speed = _speed(first, "tangent")
        tangent = first / speed
        across = np.eye(3) - tangent[..., :, None] * tangent[..., None, :]
        return np.asarray(across / speed[..., None] @ _spread(w1))

    def _torsion_weights(self, s: ArrayLike, order: int = 0) -> Array:
        return bernstein(self.torsion.size, s, order)[..., 1:]

    def _double_reflections(self, start: Array, end: Array) -> Array:
        """(n, 3, 3) rotations that carry the frame from each parameter of `start` to that of `end`."""
        tangent, goal = self.tangent(start), self.tangent(end)
        # The direction of a chord of no length is that of the tangent.
        nearby = (end - start < _NO_STEP)[:, None]
        chord = _reflections(np.where(nearby, tangent, self.position(end) - self.position(start)))
        return np.asarray(_reflections(goal - np.einsum("nij,nj->ni", chord, tangent)) @ chord)

    @cached_property
    def _cells(self) -> Array:
        """The family's cells for quadrature; where the curve has nearly a cusp, graded towards it."""
        cells = self.family.cells
        at = within(cells, self.family.gauss[0]).ravel()
        speed = np.linalg.norm(self.family.quadrature[0] @ self.control_vertices, axis=-1).ravel()
        beside = np.pad(speed, 1, constant_values=np.inf)
        dips = (speed < _DIP * speed.mean()) & (speed <= beside[:-2]) & (speed <= beside[2:])
        if not dips.any():
            return cells
        around = np.pad(at, 1, constant_values=(0.0, 1.0))
        widths, found = 0.5 ** np.arange(_GRADES), [cells]
        for k in np.flatnonzero(dips):
            low, high = around[k], around[k + 2]
            # The square of the speed is smooth, and least where the curve turns back.
            for _ in range(_GRADES):
                s = np.linspace(low, high, 9)
                least = int(np.argmin(np.linalg.norm(self.derivative(s), axis=-1)))
                low, high = s[max(least - 1, 0)], s[min(least + 1, 8)]
            middle = 0.5 * (low + high)
            found += [np.array([middle]), middle - widths, middle + widths]
        graded = np.unique(np.concatenate(found))
        return np.asarray(graded[(graded >= 0.0) & (graded <= 1.0)])

    def _integral(self, integrand: Callable[[Array, Array], Array], s: ArrayLike) -> Array:
        """Integrate a function of the tables w', w'' over 0 to s; its values may have further axes."""
        return self._from_cells(integrand, s, self._over_cells(integrand, (1, 2)), (1, 2))

    def _over_cells(self, integrand: Callable[..., Array], orders: tuple[int, ...]) -> Array:
        """Return the integrals (C + 1, ...) of a function of tables of these `orders` until the end of each cell."""
        cells, tables = self._cells, [self.family.quadrature[order - 1] for order in orders]
        if cells is not self.family.cells:
            inside = within(cells, self.family.gauss[0])
            tables = [self.family.weights(inside, order) for order in orders]
        whole = self._quadrature(np.diff(cells), integrand(*tables))
        return np.concatenate([np.zeros((1, *whole.shape[1:])), np.cumsum(whole, axis=0)])

    def _from_cells(
        self, integrand: Callable[..., Array], s: ArrayLike, until: Array, orders: tuple[int, ...]
    ) -> Array:
        """Return the integral over 0 to s, with the integrals `until` the end of each cell."""
        s, cells = np.asarray(s, dtype=float), self._cells
        flat = np.clip(s.ravel(), 0.0, 1.0)
        cell = np.clip(np.searchsorted(cells, flat, side="right") - 1, 0, len(cells) - 2)
        rest = flat - cells[cell]
        points = cells[cell, None] + rest[:, None] * self.family.gauss[0]
        values = integrand(*(self.family.weights(points, order) for order in orders))
        total = until[cell] + self._quadrature(rest, values)
        return np.asarray(total.reshape(s.shape + total.shape[1:]))

    def _quadrature(self, widths: Array, values: Array) -> Array:
        """Integrate `values` (n, G, ...) at Gauss points of intervals of some `widths` (n,): (n, ...)."""
        return np.asarray((np.tensordot(self.family.gauss[1], values, axes=(0, 1)).T * widths).T)


def straight_curve(family: CurveFamily, start: ArrayLike, end: ArrayLike) -> Curve:
    """Lay a straight curve from `start` (3,) to `end` (3,), m: control vertices at the family's abscissae."""
    start, end = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    return Curve(family, start + family.abscissae[:, None] * (end - start))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / _speed(vectors, "tangent"))


def _curvature_binormal(first: Array, second: Array) -> Array:
    """Kappa b = r' x r'' / |r'|^3, 1/m: (..., 3)."""
    return np.asarray(np.cross(first, second) / _speed(first, "curvature") ** 3)


def _speed(first: Array, what: str) -> Array:
    """Return |r'| (..., 1), by which `what` is divided."""
    speed = np.asarray(np.linalg.norm(first, axis=-1, keepdims=True))
    if not np.all(speed > 0.0):
        raise CurveError(
            f"the curve has no {what} where its derivative vanishes; part its control vertices there"
        )
    return speed


def _spread(weights: Array) -> Array:
    """(..., V) weights as the rows (..., 3, 3 V) of d(sum w_i p_i)/dp."""
    rows = weights[..., None, :, None] * np.eye(3)[:, None, :]
    return np.asarray(rows.reshape(*weights.shape[:-1], 3, 3 * weights.shape[-1]))


def _running_products(turns: Array) -> Array:
    """(n + 1, 3, 3) products of the first 0..n of (n, 3, 3) rotations, later ones on the left."""
    products = np.concatenate([np.eye(3)[None], turns])
    # Doubling spans takes log2 n batched products instead of n single ones.
    span = 1
    while span < len(products):
        products[span:] = products[span:] @ products[:-span]
        span *= 2
    return products


def _reflections(normals: Array) -> Array:
    square = np.einsum("ni,ni->n", normals, normals)
    if not np.all(square > 0.0):
        raise CurveError("the curve turns back on itself within a step; part its control vertices there")
    return np.asarray(np.eye(3) - 2.0 * normals[:, :, None] * normals[:, None, :] / square[:, None, None])
