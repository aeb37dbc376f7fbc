"""From the ``[arm]`` table of a problem to the chain of its joints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vgtm_qp.arm.serial.chain import SerialChain
from vgtm_qp.problem.arm import ArmTable
from vgtm_qp.rotation import rotation_from_vector


def build_chain(spec: ArmTable) -> SerialChain:
    """Return the joints of a validated table; those locked from the start are stuck at home."""
    joints, stuck = spec.joint, {lock.member for lock in spec.locked if lock.time == 0.0}
    axis = np.array([joint.axis for joint in joints], dtype=float)
    free = (-np.inf, np.inf)
    chain = SerialChain(
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
        every=spec.every or 1,
        locked=np.array([joint.name in stuck for joint in joints]),
        radius=spec.link_radius,
    )
    return chain if spec.every else replace(chain, every=_every(chain))


def _every(chain: SerialChain) -> int:
    """Return the least distance of stations, in joints, at which all of them can keep to the curve at once at home.

    Where there is none, as at the straight home of a snake, there is a station for every three actuators.
    """
    joints, tip = len(chain), len(chain) + 1
    for every in range(1, joints + 1):
        if chain.holds_origins([*range(1 + every, joints + 1, every), tip]):
            return every
    return -(-joints // max(1, int((~chain.locked).sum()) // 3))
