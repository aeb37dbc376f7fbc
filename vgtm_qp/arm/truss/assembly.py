"""What all builders share: a truss from positions, stages and rows of members, with its limits and joints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vgtm_qp.arm.truss.joints import axial_joints, joint_triangles
from vgtm_qp.arm.truss.truss import Array, Index, Truss
from vgtm_qp.errors import TrussError
from vgtm_qp.problem.truss import ModuleTruss, PlateTruss, TetrahedralTruss


class MemberRow(NamedTuple):
    """A member before its truss: name, indices of its two nodes, and whether it changes its length."""

    name: str
    nodes: tuple[int, int]
    actuated: bool


def assemble(
    spec: ModuleTruss | TetrahedralTruss | PlateTruss,
    node_names: tuple[str, ...],
    home: Array,
    stage: Index,
    members: Sequence[MemberRow],
    stroke_factors: tuple[float, float],
    *,
    faces: Index,
    weights: Sequence[float],
    tip: Index,
    tip_weights: Sequence[float],
    bays: int,
    trackable: tuple[str, ...],
    face_stride: int = 1,
) -> Truss:
    """Return the truss of a table, whose face and tip frames at home are those of the base.

    Parameters
    ----------
    stroke_factors
        Least and greatest length of an actuated member over its home length, where the table has no stroke.
    weights
        Of the three nodes of every face.

    Other parameters are as in :class:`vgtm_qp.arm.truss.truss.Truss`.

    Raises
    ------
    TrussError
        A home length is outside its stroke, or the joint offsets leave no member.
    """
    names = tuple(member.name for member in members)
    pairs = np.array([member.nodes for member in members], dtype=np.int64)
    actuated = np.array([member.actuated for member in members])
    lengths = np.linalg.norm(home[pairs[:, 0]] - home[pairs[:, 1]], axis=1)
    offset, joints = spec.joint_offset, None
    if not 2.0 * offset < lengths.min():
        raise TrussError(
            f"joint_offset is {offset:g} m; expected at least 0 and less than half the shortest member, "
            f"{lengths.min() / 2:g} m"
        )
    if offset > 0.0:
        triangle = joint_triangles(node_names, home, pairs, stage)
        joints = axial_joints(home, pairs, triangle, np.full((len(members), 2), offset))
    strokes = np.column_stack([lengths - 2.0 * offset] * 2)
    strokes[actuated] *= stroke_factors
    if spec.stroke is not None:
        for k in np.flatnonzero(actuated):
            check_stroke(names[k], lengths[k] - 2.0 * offset, spec.stroke)
        strokes[actuated] = spec.stroke
    return Truss(
        module=spec.module,
        node_names=node_names,
        member_names=names,
        home=home,
        base=stage < 0,
        members=pairs,
        actuated=actuated,
        stroke=strokes,
        rate=np.where(actuated, spec.rate or np.inf, np.inf),
        acceleration=np.where(actuated, spec.acceleration or np.inf, np.inf),
        radius=np.full(len(members), spec.member_radius),
        faces=faces,
        face_weights=np.tile(np.asarray(weights, dtype=np.float64), (len(faces), 1)),
        face_frames=np.tile(np.eye(3), (len(faces), 1, 1)),
        tip=tip,
        tip_weights=np.asarray(tip_weights, dtype=np.float64),
        tip_frame=np.eye(3),
        stage=stage,
        bays=bays,
        trackable=trackable,
        face_stride=face_stride,
        joints=joints,
    )


def check_stroke(name: str, length: float, stroke: Sequence[float]) -> None:
    """Refuse a home length, m, outside its stroke."""
    least, greatest = stroke
    if not least - 1e-9 <= length <= greatest + 1e-9:
        raise TrussError(
            f"the home length of member {name}, {length:g} m, is outside its stroke [{least:g}, {greatest:g}] m"
        )
