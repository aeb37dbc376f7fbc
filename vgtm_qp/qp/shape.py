"""Rows of curves that constant tables do not describe: nodes by arc length, torsion, spacing (sections 4.3-4.4)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.compiled import Kernel
from vgtm_qp.curve.curve import Curve
from vgtm_qp.qp.curve_rows import CurvePlacing, curve_function, point_function
from vgtm_qp.rows.curve import spacings


class CurveRows(NamedTuple):
    """A curve at its K nodes and the rows over its D = 3 V + T coordinates.

    See eqs. (32)-(36).

    Attributes
    ----------
    position, position_rows : (K, 3), (K, 3, D)
        r(s_k), m.
    frame, spin_rows : (K, 3, 3), (K, 3, D)
        F(s_k), its third column the tangent, and its angular velocity; without roll, those of the tangent.
    spacing, spacing_rows : (S,), (S, D)
        Distances of successive nodes less those at home, m, from the base on; S = 0 without that objective.
    """

    position: Array
    position_rows: Array
    frame: Array
    spin_rows: Array
    spacing: Array
    spacing_rows: Array


@dataclass(frozen=True, eq=False)
class CurveShape(CurvePlacing):
    """The rows of a curve whose nodes are placed and tracked as :class:`CurvePlacing` says."""

    @property
    def is_plain(self) -> bool:
        """Whether constant tables of weights at the nodes describe the curve."""
        return not (self.by_arc_length or self.tracks_roll or self.torsion or self.spacing is not None)

    @property
    def turns(self) -> int:
        """Number of turns that a station tracks: two tilts, and the roll with `tracks_roll`."""
        return 3 if self.tracks_roll else 2

    @property
    def spacings(self) -> int:
        """Number S of spacing rows."""
        return 0 if self.spacing is None else len(self.spacing)

    @property
    def parameters(self) -> Array:
        """(K,) parameters of the tables of weights; nodes by arc length are located again on each curve."""
        return self.nodes

    def at(self, vertices: Array, torsion: Array, base_frame: Array) -> CurveRows:
        """Return positions and frames alone, with zeros for all else; see :meth:`rows`."""
        found = _evaluated(self._points, vertices, torsion, base_frame)
        if found is None:
            curve, s = self._nodes_of(vertices, torsion, base_frame)
            position, frame = curve.position(s), self._frame(curve, s)
        else:
            position, frame = (array.reshape(len(self.nodes), 3, -1) for array in found)
        count, size = len(self.nodes), vertices.size + torsion.size
        nothing = np.zeros((count, 3, size))
        spacing = np.zeros(self.spacings), np.zeros((self.spacings, size))
        return CurveRows(position.reshape(count, 3), nothing, frame, nothing, *spacing)

    def rows(self, vertices: Array, torsion: Array, base_frame: Array) -> CurveRows:
        """Return the rows at control vertices (V, 3), torsion (T,), with the frame (3, 3) of the base face.

        Raises
        ------
        CurveError
            The curve has no tangent or no frame somewhere.
        """
        found = _evaluated(self._rows, vertices, torsion, base_frame)
        if found is None:
            return self.rows_of_any(vertices, torsion, base_frame)
        count, size = len(self.nodes), vertices.size + torsion.size
        shapes = (count, 3), (count, 3, size), (count, 3, 3), (count, 3, size), (-1,), (self.spacings, size)
        return CurveRows(*(array.reshape(shape) for array, shape in zip(found, shapes, strict=True)))

    @cached_property
    def _points(self) -> Kernel:
        return point_function(self).kernel()

    @cached_property
    def _rows(self) -> Kernel:
        return curve_function(self).kernel()

    def rows_of_any(self, vertices: Array, torsion: Array, base_frame: Array) -> CurveRows:
        """Return :meth:`rows` by the curve itself, in twenty times the time; it may nearly have a cusp.

        Nodes by arc length move along the curve when it changes, see ``Curve.arc_node_rates``.
        """
        curve, s = self._nodes_of(vertices, torsion, base_frame)
        position_rows, frame = curve.position_jacobian(s), self._frame(curve, s)
        if self.tracks_roll:
            spin_rows = curve.orientation_jacobian(s)
        else:
            # Without roll only the tangent turns, and no integrals along the curve are needed.
            turned = np.cross(frame[:, None, :, 2], np.swapaxes(curve.tangent_jacobian(s), 1, 2))
            spin_rows = np.swapaxes(turned, 1, 2)
        if self.by_arc_length:
            rates = curve.arc_node_rates(s)[:, None, :]
            position_rows = position_rows + curve.derivative(s)[:, :, None] * rates
            spin_rows = spin_rows + curve.frame_rate(s)[:, :, None] * rates
        position = curve.position(s)
        spacing, spacing_rows = np.zeros(0), np.zeros((0, curve.coordinates))
        if self.spacing is not None:
            points = np.vstack([vertices[:1], position])
            rows = np.concatenate([np.eye(3, curve.coordinates)[None], position_rows])
            distance, spacing_rows = spacings(points, rows)
            spacing = distance - self.spacing
        return CurveRows(position, position_rows, frame, spin_rows, spacing, spacing_rows)

    @cached_property
    def _home_roll(self) -> Array:
        roll = np.zeros(len(self.nodes)) if self.roll is None else self.roll
        turn = np.zeros((len(roll), 3, 3))
        turn[:, 0, 0] = turn[:, 1, 1] = np.cos(roll)
        turn[:, 1, 0] = np.sin(roll)
        turn[:, 0, 1] = -turn[:, 1, 0]
        turn[:, 2, 2] = 1.0
        return turn

    def _nodes_of(self, vertices: Array, torsion: Array, base_frame: Array) -> tuple[Curve, Array]:
        """Return the curve, and the parameters (K,) of its nodes."""
        curve = Curve(self.family, vertices, torsion, base_frame)
        return curve, curve.arc_parameter(self.nodes) if self.by_arc_length else self.nodes

    def _frame(self, curve: Curve, s: Array) -> Array:
        """Return (K, 3, 3) the frames that stations track; without roll only the tangents, in the third column."""
        if self.tracks_roll:
            return curve.frame(s) @ self._home_roll
        frame = np.zeros((len(s), 3, 3))
        frame[:, :, 2] = curve.tangent(s)
        return frame


def _evaluated(kernel: Kernel, vertices: Array, torsion: Array, base_frame: Array) -> list[Array] | None:
    """Return copies of a kernel's results but the last, which says whether they are right; None if they are not."""
    for argument, values in zip(kernel.inputs, (vertices, torsion, base_frame.T), strict=False):
        argument[:] = values.reshape(-1)
    kernel()
    *found, sound = kernel.outputs
    return [array.copy() for array in found] if sound[0] else None
