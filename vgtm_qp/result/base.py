"""Where the problem holds the base over time, eqs. (7)-(8)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.result.rotation import continued

Array = NDArray[np.float64]


def base_poses(problem: Mapping[str, Any], times: Array) -> Array:
    """Return (T, 6) position, m, and rotation vector, rad, of the base against home at `times` (T,), s.

    A base that moves goes from pose to pose on straight lines and single-axis rotations, from its home pose at time 0
    on, and stays in the last one.
    """
    poses = (problem.get("truss") or problem.get("arm") or {}).get("base_motion") or ()
    found = np.zeros((len(times), 6))
    if not poses:
        return found
    from scipy.spatial.transform import Rotation

    still = (0.0, 0.0, 0.0)
    shift = np.array([still, *(pose.get("position") or still for pose in poses)], dtype=float)
    turn = Rotation.from_rotvec([still, *(pose.get("rotation_vector") or still for pose in poses)])
    knots = np.array([0.0, *(float(pose["time"]) for pose in poses)])
    for row, time in enumerate(times):
        k = int(np.clip(np.searchsorted(knots, time, side="right") - 1, 0, len(knots) - 2))
        share = float(np.clip((time - knots[k]) / (knots[k + 1] - knots[k]), 0.0, 1.0))
        between = (turn[k + 1] * turn[k].inv()).as_rotvec()
        found[row, :3] = (1.0 - share) * shift[k] + share * shift[k + 1]
        vector = (Rotation.from_rotvec(share * between) * turn[k]).as_rotvec()
        found[row, 3:] = continued(vector, found[row - 1, 3:] if row else np.zeros(3))
    return found
