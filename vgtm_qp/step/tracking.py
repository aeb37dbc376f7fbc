"""How far faces that are to stay on the curve exactly are from it: what a linear row leaves, and a step must not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.truss.kinematics import Kinematics
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.shape import turn_rows
from vgtm_qp.step.linearise import base_frame

Array = NDArray[np.float64]


class HardTracking:
    """Measures the tracking of a layout with hard rows."""

    def __init__(self, layout: Layout, kinematics: Kinematics) -> None:
        self._layout, self._kinematics = layout, kinematics

    def error(self, X: Array, vertices: Array, torsion: Array, base_rotation: Array | None) -> float:
        """Return the greatest gap, m, or turn, rad, that should be none.

        Parameters
        ----------
        X, vertices, torsion
            Node positions (N, 3), m, and the curve's coordinates (V, 3), m, and (T,), rad.
        base_rotation
            (3, 3) rotation of the base, None where it rests.
        """
        layout, kinematics = self._layout, self._kinematics
        faces, shape = layout.tracked, layout.general
        if layout.hard_turns:
            kinematics.evaluate(X)
        centres = kinematics.face_centres(X)[faces]
        if shape is None:
            worst = float(np.abs(centres - layout.curve_weights @ vertices).max(initial=0.0))
            if layout.hard_turns:
                slopes = layout.curve_slopes @ vertices
                tangents = slopes / np.linalg.norm(slopes, axis=1, keepdims=True)
                along = np.einsum("kca,kc->ka", kinematics.face_rotation[faces][:, :, :2], tangents)
                worst = max(worst, float(np.abs(along).max(initial=0.0)))
            return worst
        rows = shape.rows(vertices, torsion, base_frame(layout.truss, base_rotation))
        worst = float(np.abs(centres - rows.position).max(initial=0.0))
        if layout.hard_turns:
            turns = turn_rows(
                rows, kinematics.face_rotation[faces], kinematics.face_spin[faces], layout.turns
            )
            worst = max(worst, float(np.abs(turns.residual).max(initial=0.0)))
        return worst
