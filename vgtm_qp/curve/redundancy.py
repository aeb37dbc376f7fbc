"""Variable degree of redundancy, section 4.7: more or fewer control vertices for the same shape."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.curve.curve import Curve
from vgtm_qp.curve.families import CurveFamily, b_spline, beta_spline, bezier, within
from vgtm_qp.errors import CurveError

BASE_ROWS = 5
"""Conditions that hold a curve at its base: p_0 in its place, p_1 on the base normal."""

_LEAST_VERTICES = 3
_SAMPLES = 1000


class Refit(NamedTuple):
    """A curve fitted to another one, with the same ends, base tangent's direction, torsion and base frame."""

    curve: Curve
    change: float
    """Greatest distance between old and new position at the same s, m, sampled at 100 parameters a segment."""


def degree_of_redundancy(control_vertices: int, tip_rows: int, torsion_vertices: int = 0) -> int:
    """Count the free motions of a curve held at base and tip, 3 V + T - 5 - tip rows; negative if too few."""
    return 3 * control_vertices + torsion_vertices - BASE_ROWS - tip_rows


def excess_freedom(curve_dof: int, arm_dof: int) -> str | None:
    """Warn of a curve with more degrees of freedom than the arm that tracks it, or return None.

    Both are counted with the tip held, or both with the tip free.
    """
    excess = curve_dof - arm_dof
    if excess <= 0:
        return None
    return (
        f"the reference curve has {curve_dof} degrees of freedom and the arm {arm_dof}: {excess} without effect on the "
        "arm, which only cost time"
    )


def add_control_vertices(curve: Curve, count: int = 1) -> Refit:
    """Give a curve more control vertices where it is.

    A Bezier curve is raised in degree; a B-spline gets knots, each in the middle of the longest span. Both
    move by rounding alone. A uniform Beta-spline cannot keep its shape exactly, and moves by `change`.
    CurveError where `count` is negative, or the family is a chain of segments without knots.
    """
    _require_count(count)
    family = curve.family
    if not count:
        return Refit(curve, 0.0)
    if family.name == "bezier":
        return refit(curve, bezier(family.control_vertices + count))
    if family.name == "beta-spline":
        return refit(curve, beta_spline(family.control_vertices + count, family.bias, family.tension))
    _require_knots(family)
    degree, knots = family.degree, family.knots
    for _ in range(count):
        longest = int(np.argmax(np.diff(knots)))
        knots = np.insert(knots, longest + 1, knots[longest : longest + 2].mean())
    interior = knots[degree + 1 : -degree - 1]
    return refit(curve, b_spline(family.control_vertices + count, degree, interior))


def remove_control_vertices(curve: Curve, count: int = 1) -> Refit:
    """Give a curve fewer control vertices, by least squares; `change` says how far it moved.

    A B-spline loses the knots whose loss changes it least; without interior knots its degree falls.
    CurveError where `count` is negative, or fewer than three control vertices would be left for both ends and
    the base tangent.
    """
    _require_count(count)
    lowered = curve
    for _ in range(count):
        fits = [refit(lowered, family) for family in _lower_families(lowered.family)]
        lowered = min(fits, key=lambda fit: fit.change).curve
    return Refit(lowered, _greatest_change(curve, lowered))


def refit(curve: Curve, family: CurveFamily) -> Refit:
    """Fit a curve of another family or number of control vertices: least squares of r(s) over 0 <= s <= 1.

    Both ends and the direction of the base tangent are kept; the distance of p_1 from p_0 is free. CurveError where the
    family has fewer than three control vertices, or the curve has no tangent at its base.
    """
    vertices = family.control_vertices
    if vertices < _LEAST_VERTICES:
        raise CurveError(
            f"a curve with {vertices} control vertices cannot keep both ends and the base tangent; use "
            f"{_LEAST_VERTICES} or more"
        )
    start, end = curve.position(0.0), curve.position(1.0)
    tangent = curve.tangent(0.0)
    s, weight = _quadrature(curve.family, family)
    table = family.weights(s)
    known = np.outer(table[:, :2].sum(axis=1), start) + np.outer(table[:, -1], end)
    # Unknowns: the distance from p_0 to p_1 along the tangent, then the vertices between p_1 and the last.
    first, inner = np.outer(table[:, 1], tangent), np.kron(table[:, None, 2:-1], np.eye(3))
    columns = np.concatenate([first[..., None], inner], axis=2)
    goal = (curve.position(s) - known) * weight[:, None]
    matrix = (columns * weight[:, None, None]).reshape(goal.size, -1)
    solution = np.linalg.lstsq(matrix, goal.ravel())[0]
    if solution[0] <= 0.0:
        # Least squares would turn the base tangent around: keep r'(0) itself instead.
        kept = np.linalg.norm(curve.derivative(0.0)) / family.weights(0.0, 1)[1]
        rest = np.linalg.lstsq(matrix[:, 1:], goal.ravel() - kept * matrix[:, 0])[0]
        solution = np.concatenate([[kept], rest])
    control = np.vstack([start, start + solution[0] * tangent, solution[1:].reshape(-1, 3), end])
    fitted = replace(curve, family=family, control_vertices=control)
    return Refit(fitted, _greatest_change(curve, fitted))


def _require_count(count: int) -> None:
    if count < 0:
        raise CurveError(f"the number of control vertices to add or remove must be 0 or more, not {count}")


def _require_knots(family: CurveFamily) -> None:
    if not len(family.knots):
        raise CurveError(
            f"a curve of {family.name} keeps its number of control vertices; expected a bezier, b-spline or beta-spline"
        )


def _quadrature(*families: CurveFamily) -> tuple[Array, Array]:
    """Gauss points of the common segments, exact for squares, and the square roots of their weights."""
    breaks = np.unique(np.concatenate([family.breaks for family in families]))
    nodes, weights = np.polynomial.legendre.leggauss(max(family.degree for family in families) + 1)
    width = np.diff(breaks)[:, None]
    return within(breaks, (nodes + 1.0) / 2.0).ravel(), np.sqrt(width * weights / 2.0).ravel()


def _greatest_change(old: Curve, new: Curve) -> float:
    breaks = np.unique(np.concatenate([old.family.breaks, new.family.breaks]))
    s = within(breaks, np.linspace(0.0, 1.0, _SAMPLES)).ravel()
    return float(np.linalg.norm(new.position(s) - old.position(s), axis=1).max())


def _lower_families(family: CurveFamily) -> list[CurveFamily]:
    """Candidate families with one control vertex less."""
    vertices = family.control_vertices - 1
    if vertices < _LEAST_VERTICES:
        raise CurveError(
            f"a curve with {family.control_vertices} control vertices cannot lose one and keep both ends and "
            f"its base tangent; {_LEAST_VERTICES} are the least"
        )
    if family.name == "bezier":
        return [bezier(vertices)]
    if family.name == "beta-spline":
        return [beta_spline(vertices, family.bias, family.tension)]
    _require_knots(family)
    degree = family.degree
    interior = family.knots[degree + 1 : -degree - 1]
    if not interior.size:
        return [b_spline(vertices, degree - 1)]
    _, first = np.unique(interior, return_index=True)
    return [b_spline(vertices, degree, np.delete(interior, k)) for k in first]
