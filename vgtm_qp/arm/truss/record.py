"""What a result file records of the arm, so that it can be verified without the code that moved it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.truss.truss import Truss


def arm_record(truss: Truss) -> dict[str, Any]:
    """Return what verification needs to know of `truss`, as JSON data; None means no limit.

    Keys: ``module``, ``bays``, ``node_names``, ``home`` (N, 3), ``base`` (indices of given nodes),
    ``member_names``, ``actuated``, ``length`` (M, at home), ``stroke`` (M, 2), ``rate``, ``acceleration``,
    ``radius`` (M), ``tip`` (``nodes``, ``weights``, ``frame`` at home) and ``joints``
    (``triangle``, ``offset``, see ``truss.Joints``; None for pin joints). Lengths in m.
    """
    joints = truss.joints
    ends = truss.home[truss.members]
    pin_lengths = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    return {
        "module": truss.module,
        "bays": truss.bays,
        "node_names": list(truss.node_names),
        "home": truss.home.tolist(),
        "base": np.flatnonzero(truss.base).tolist(),
        "member_names": list(truss.member_names),
        "actuated": truss.actuated.tolist(),
        "length": (pin_lengths if joints is None else truss.home_lengths).tolist(),
        "stroke": truss.stroke.tolist(),
        "rate": _or_none(truss.rate),
        "acceleration": _or_none(truss.acceleration),
        "radius": truss.radius.tolist(),
        "tip": {
            "nodes": truss.tip.tolist(),
            "weights": truss.tip_weights.tolist(),
            "frame": truss.tip_frame.tolist(),
        },
        "joints": None
        if joints is None
        else {"triangle": joints.triangle.tolist(), "offset": joints.offset.tolist()},
    }


def _or_none(limits: NDArray[np.float64]) -> list[float | None]:
    return [limit if math.isfinite(limit) else None for limit in limits.tolist()]
