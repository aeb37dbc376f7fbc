"""Curve families, section 4.2: each r(s) = sum w_i(s) p_i is a chain of Bezier segments, linear in p."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import pairwise
from math import comb, perm

import numpy as np
from numpy.typing import ArrayLike

from vgtm_qp.arrays import Array
from vgtm_qp.errors import CurveError, nearest

FAMILIES = ("bezier", "b-spline", "beta-spline", "segments")

_QUADRATURE_CELLS = 128
_GAUSS_POINTS = 8
_OUTSIDE = 1e-12


_MOST_KNOWN = 64
"""Number of arrays of weights that a family keeps."""


@dataclass(frozen=True, eq=False)
class CurveFamily:
    """The weights w_i(s), 0 <= s <= 1, of a curve's control vertices: non-negative, with sum 1.

    See eqs. (29)-(30).
    """

    name: str
    """One of `FAMILIES`."""
    degree: int
    """Degree d of the segments."""
    breaks: Array
    """(S + 1,) parameters at which the segments begin and end, from 0 to 1."""
    extraction: Array
    """(S, d + 1, V) Bezier points of each segment as weighted averages of the V control vertices."""
    abscissae: Array
    """(V,) fractions of a straight line: control vertices there give r(s) linear along it (Greville abscissae).

    With bias != 1 or tension > 0 it is the same line, but the speed along it varies.
    """
    smooth: bool
    """True if the direction of the tangent is continuous wherever it exists."""
    knots: Array
    """(V + d + 1,) knots of a B-spline; empty for the other families."""
    bias: float = 1.0
    tension: float = 0.0
    """Shape parameters of a Beta-spline."""

    @property
    def control_vertices(self) -> int:
        """Number of control vertices V (the paper's N + 1)."""
        return len(self.abscissae)

    def weights(self, s: ArrayLike, order: int = 0) -> Array:
        """Weights w_i, eq. (30), or their derivatives of `order` by s, at s of any shape: (..., V).

        At a break where a derivative jumps it is the one of the segment that begins there. CurveError where some s is
        outside 0 <= s <= 1 or is not a number. The array is read-only: curves ask for the same parameters again and
        again, and get the same array.
        """
        given = np.asarray(s, dtype=float)
        key = given.tobytes(), given.shape, order
        if (known := self._known.get(key)) is None:
            if len(self._known) >= _MOST_KNOWN:
                self._known.clear()
            known = self._known[key] = self._weights(given, order)
            known.setflags(write=False)
        return known

    @cached_property
    def _known(self) -> dict[tuple[bytes, tuple[int, ...], int], Array]:
        return {}

    def _weights(self, given: Array, order: int) -> Array:
        if not np.all((given >= -_OUTSIDE) & (given <= 1.0 + _OUTSIDE)):
            raise CurveError("the curve parameter s must be within 0 <= s <= 1")
        at = np.clip(given, 0.0, 1.0)
        segment = np.searchsorted(self.breaks[1:-1], at, side="right")
        width = np.diff(self.breaks)[segment]
        table = bernstein(self.degree, (at - self.breaks[segment]) / width, order)
        if len(self.breaks) == 2:
            return np.asarray(table @ self.extraction[0])
        table = table / width[..., None] ** order
        return np.asarray(np.einsum("...j,...jv->...v", table, self.extraction[segment]))

    @cached_property
    def cells(self) -> Array:
        """(C + 1,) a subdivision of the segments, fine enough for quadrature and for moving a frame along."""
        return self.divided(_QUADRATURE_CELLS)

    def divided(self, cells: int) -> Array:
        """Return (C + 1,) the ends of at least so many `cells` in equal parts of the segments."""
        pieces = max(2, -(-cells // (len(self.breaks) - 1)))
        return np.append(within(self.breaks, np.arange(pieces) / pieces), 1.0)

    @cached_property
    def gauss(self) -> tuple[Array, Array]:
        """(G,) nodes and (G,) weights of Gauss-Legendre quadrature on [0, 1]."""
        nodes, weights = np.polynomial.legendre.leggauss(_GAUSS_POINTS)
        return (nodes + 1.0) / 2.0, weights / 2.0

    @cached_property
    def quadrature(self) -> tuple[Array, Array]:
        """(C, G, V) tables of w' and w'' at the Gauss points of the cells."""
        points = within(self.cells, self.gauss[0])
        return self.weights(points, 1), self.weights(points, 2)


def bezier(control_vertices: int) -> CurveFamily:
    """Bezier curve of degree V - 1; CurveError for fewer than two control vertices."""
    _require_vertices("bezier", control_vertices, 2)
    without_knots = b_spline(control_vertices, control_vertices - 1)
    return replace(without_knots, name="bezier", knots=np.empty(0))


def b_spline(
    control_vertices: int, degree: int = 3, interior_knots: Sequence[float] | Array | None = None
) -> CurveFamily:
    """B-spline of any degree whose ends are clamped at the first and last control vertex.

    The `interior_knots` (V - degree - 1,) do not decrease, each strictly between 0 and 1 and at most `degree` times;
    they are uniform where not given. CurveError for a degree below 1, for fewer than degree + 1 control vertices, and
    for wrong knots.
    """
    if degree < 1:
        raise CurveError(f"the degree of a b-spline must be 1 or more, not {degree}")
    _require_vertices(f"b-spline of degree {degree}", control_vertices, degree + 1)
    count = control_vertices - degree - 1
    if interior_knots is None:
        interior = np.linspace(0.0, 1.0, count + 2)[1:-1]
    else:
        interior = np.asarray(interior_knots, dtype=float)
    inside = interior.shape == (count,) and np.all((interior > 0.0) & (interior < 1.0))
    if not inside or np.any(np.diff(interior) < 0.0):
        raise CurveError(
            f"a b-spline of degree {degree} with {control_vertices} control vertices takes {count} interior "
            "knots, not decreasing, each between 0 and 1"
        )
    breaks, multiplicity = np.unique(np.concatenate([[0.0], interior, [1.0]]), return_counts=True)
    if np.any(multiplicity > degree):
        raise CurveError(f"a knot may be repeated at most {degree} times in a b-spline of degree {degree}")
    knots = np.concatenate([np.zeros(degree + 1), interior, np.ones(degree + 1)])
    return CurveFamily(
        name="b-spline",
        degree=degree,
        breaks=breaks,
        extraction=_extraction(knots, degree, breaks),
        abscissae=np.lib.stride_tricks.sliding_window_view(knots[1:-1], degree).mean(axis=1),
        smooth=bool(np.all(multiplicity[1:-1] < degree)),
        knots=knots,
    )


def beta_spline(control_vertices: int, bias: float = 1.0, tension: float = 0.0) -> CurveFamily:
    """Uniform cubic Beta-spline (Barsky) that passes through its first and last control vertex.

    With b1 the bias and b2 the tension, segments join with r'+ = b1 r'- and r''+ = b1^2 r''- + b2 r'- (in the
    segments' own parameters): direction of the tangent and curvature are continuous, r' itself is not unless
    b1 = 1. Two phantom vertices, p_0 + (p_0 - p_1) / b1^3 and p_N + b1^3 (p_N - p_N-1), bring it to its end
    vertices along the first and last leg of the control polygon. CurveError for fewer than two control vertices, a
    bias that is not positive, or a negative tension.
    """
    _require_vertices("beta-spline", control_vertices, 2)
    if not (np.isfinite(bias) and bias > 0.0):
        raise CurveError(f"the bias of a beta-spline must be greater than 0, not {bias}")
    if not (np.isfinite(tension) and tension >= 0.0):
        raise CurveError(f"the tension of a beta-spline must be 0 or more, not {tension}")
    b1, b2 = bias, tension
    delta = 2 * b1**3 + 4 * b1**2 + 4 * b1 + b2 + 2
    segment = np.array(
        [
            [2 * b1**3, 4 * b1**2 + 4 * b1 + b2, 2.0, 0.0],
            [0.0, 2 * b1**3 + 4 * b1**2 + 2 * b1 + b2, 2 * b1 + 2, 0.0],
            [0.0, 2 * b1**3 + 2 * b1**2, 2 * b1**2 + 4 * b1 + b2 + 2, 0.0],
            [0.0, 2 * b1**3, 4 * b1**2 + 4 * b1 + b2, 2.0],
        ]
    )
    segments = control_vertices - 1
    extended = np.zeros((segments, 4, control_vertices + 2))
    for k in range(segments):
        extended[k, :, k : k + 4] = segment
    extraction = extended[:, :, 1:-1] / delta
    # The phantom vertices enter at the two ends alone, and bring those to the end vertices.
    extraction[0, 0] = np.eye(control_vertices)[0]
    extraction[-1, 3] = np.eye(control_vertices)[-1]
    return CurveFamily(
        name="beta-spline",
        degree=3,
        breaks=np.linspace(0.0, 1.0, segments + 1),
        extraction=extraction,
        abscissae=np.linspace(0.0, 1.0, control_vertices),
        smooth=True,
        knots=np.empty(0),
        bias=bias,
        tension=tension,
    )


def segments(breaks: ArrayLike, extraction: ArrayLike) -> CurveFamily:
    """Chain of Bezier segments between `breaks` (S + 1,), their points by weights (S, d + 1, V): `extraction`.

    CurveError unless the breaks increase from 0 to 1, the weights of each point have the sum 1, each segment begins
    where the one before ends, and the curve goes from the first control vertex, towards the second, to the last.
    """
    at, points = np.array(breaks, dtype=float), np.array(extraction, dtype=float)
    degree, size = points.shape[1] - 1, points.shape[2]
    _require_vertices("chain of segments", size, 2)
    if at[0] != 0.0 or at[-1] != 1.0 or np.any(np.diff(at) <= 0.0):
        raise CurveError("the breaks of the segments are others; expected breaks that increase from 0 to 1")
    corner = np.eye(size)
    wrong = {
        "weights whose sum is 1 for each Bezier point": points.sum(axis=2) - 1.0,
        "segments that begin where the one before ends": points[1:, 0] - points[:-1, -1],
        "a first Bezier point that is the first control vertex": points[0, 0] - corner[0],
        "a last Bezier point that is the last control vertex": points[-1, -1] - corner[-1],
        "a second Bezier point on the first leg of the control polygon": points[0, 1, 2:],
    }
    for expected, error in wrong.items():
        if np.abs(error).max(initial=0.0) > _OUTSIDE:
            raise CurveError(f"the weights of the segments are others; expected {expected}")
    if not points[0, 1, 1] > 0.0:
        raise CurveError("the curve begins away from its second control vertex; expected a weight above 0")
    # Control vertices at these fractions of a line give Bezier points that are evenly spaced in each segment.
    even = within(at, np.arange(degree + 1) / degree)
    abscissae = np.linalg.lstsq(points.reshape(-1, size), even.ravel(), rcond=None)[0]
    if np.abs(points @ abscissae - even).max() > _OUTSIDE or np.any(np.diff(abscissae) <= 0.0):
        abscissae = np.linspace(0.0, 1.0, size)
    before, after = points[:-1, -1] - points[:-1, -2], points[1:, 1] - points[1:, 0]
    lengths = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    smooth = bool(np.all(np.abs(np.einsum("kv,kv->k", before, after) - lengths) <= _OUTSIDE))
    return CurveFamily("segments", degree, at, points, abscissae, smooth, np.empty(0))


def make_family(
    name: str,
    control_vertices: int,
    *,
    degree: int = 3,
    bias: float = 1.0,
    tension: float = 0.0,
    breaks: ArrayLike = (),
    extraction: ArrayLike = (),
) -> CurveFamily:
    """Make a family by its name in a problem file; `degree` is the B-spline's, bias and tension the Beta-spline's.

    The rest is for :func:`segments`. CurveError for an unknown name, or for parameters that the family cannot have.
    """
    if name == "segments":
        return segments(breaks, extraction)
    if name == "bezier":
        return bezier(control_vertices)
    if name == "b-spline":
        return b_spline(control_vertices, degree)
    if name == "beta-spline":
        return beta_spline(control_vertices, bias, tension)
    raise CurveError(
        f'unknown curve family "{name}"{nearest(name, FAMILIES)}; choose from {", ".join(FAMILIES)}'
    )


def within(breaks: Array, fractions: Array) -> Array:
    """Return (S, F) the parameters at these fractions (F,) of every piece between `breaks` (S + 1,)."""
    return np.asarray(breaks[:-1, None] + np.diff(breaks)[:, None] * fractions)


def _require_vertices(family: str, control_vertices: int, least: int) -> None:
    if control_vertices < least:
        raise CurveError(f"a {family} needs at least {least} control vertices, not {control_vertices}")


def _extraction(knots: Array, degree: int, breaks: Array) -> Array:
    """(S, d + 1, V) Bezier points of each knot span, by the blossom of start and end."""
    vertices = len(knots) - degree - 1
    matrices = np.zeros((len(breaks) - 1, degree + 1, vertices))
    for k, (start, end) in enumerate(pairwise(breaks)):
        span = int(np.searchsorted(knots, start, side="right")) - 1
        for j in range(degree + 1):
            arguments = [start] * (degree - j) + [end] * j
            rows = np.eye(vertices)[span - degree : span + 1]
            for r, u in enumerate(arguments):
                lower = knots[span - degree + r + 1 : span + 1]
                upper = knots[span + 1 : span + degree - r + 1]
                alpha = ((u - lower) / (upper - lower))[:, None]
                rows = (1.0 - alpha) * rows[:-1] + alpha * rows[1:]
            matrices[k, j] = rows[0]
    return matrices


@cache
def difference(size: int, order: int) -> Array:
    """Return the (size - order, size) matrix of the `order`-th forward difference; (0, size) for a small size."""
    return np.asarray(np.diff(np.eye(size), n=order, axis=0))


@cache
def _binomials(degree: int) -> Array:
    return np.array([comb(degree, j) for j in range(degree + 1)], dtype=float)


def bernstein(degree: int, u: ArrayLike, order: int = 0) -> Array:
    """Bernstein basis of `degree`, or its derivative of `order`, at `u` of any shape: (..., degree + 1)."""
    u = np.asarray(u, dtype=float)[..., None]
    if order > degree:
        return np.zeros((*u.shape[:-1], degree + 1))
    low = degree - order
    j = np.arange(low + 1)
    table = _binomials(low) * u**j * (1.0 - u) ** (low - j)
    if order == 0:
        return np.asarray(table)
    return np.asarray(perm(degree, order) * (table @ difference(degree + 1, order)))
