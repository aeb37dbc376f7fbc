"""From the ``[arm]`` table of a problem to the chain of its joints."""

from __future__ import annotations

import numpy as np

from vgtm_qp.arm.serial.chain import SerialChain
from vgtm_qp.problem.arm import ArmTable
from vgtm_qp.rotation import rotation_from_vector


def build_chain(spec: ArmTable) -> SerialChain:
    """Return the joints of a validated table; those locked from the start are stuck at home."""
    joints, stuck = spec.joint, {lock.member for lock in spec.locked if lock.time == 0.0}
    axis = np.array([joint.axis for joint in joints], dtype=float)
    free = (-np.inf, np.inf)
    return SerialChain(
        names=tuple(joint.name for joint in joints),
        revolute=np.array([joint.kind == "revolute" for joint in joints]),
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        position=np.array([joint.position for joint in joints], dtype=float),
        rotation=np.stack([rotation_from_vector(joint.rotation_vector) for joint in joints]),
        limits=np.array([joint.limits or free for joint in joints], dtype=float),
        rate=np.array([np.inf if joint.rate is None else joint.rate for joint in joints]),
        acceleration=np.array(
            [np.inf if joint.acceleration is None else joint.acceleration for joint in joints]
        ),
        home=np.array([joint.home for joint in joints], dtype=float),
        tip=np.array(spec.tip, dtype=float),
        every=spec.every or -(-len(joints) // max(1, (len(joints) - len(stuck)) // 3)),
        locked=np.array([joint.name in stuck for joint in joints]),
        radius=spec.link_radius,
    )
