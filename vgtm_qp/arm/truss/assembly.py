"""What all builders share: a truss from positions, stages and rows of members, with its limits and joints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, TypedDict

import numpy as np

from vgtm_qp.arm.truss.joints import axial_joints, joint_triangles
from vgtm_qp.arm.truss.truss import Array, Index, Mask, Truss
from vgtm_qp.errors import TrussError


class Limits(TypedDict, total=False):
    """What every builder takes by keyword besides its dimensions."""

    stroke: Sequence[float] | None
    """Least and greatest length of an actuated member, m; the module's factors times home if not given."""
    rate: float | None
    """Greatest |dl/dt| of an actuated member, m/s; none if not given."""
    acceleration: float | None
    """Greatest |d2l/dt2| of an actuated member, m/s^2; none if not given."""
    member_radius: float
    """Radius of every member, m; 0.03 if not given."""
    joint_offset: float
    """Distance from node to member end, along the member at home, m; 0 (pin joints) if not given."""


class MemberRow(NamedTuple):
    """A member before its truss: name, indices of its two nodes, and whether it changes its length."""

    name: str
    nodes: tuple[int, int]
    actuated: bool


def assemble(
    module: str,
    node_names: tuple[str, ...],
    home: Array,
    stage: Index,
    members: Sequence[MemberRow],
    limits: Limits,
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
    """Return the truss whose face and tip frames at home are those of the base.

    Parameters
    ----------
    members
        Rows of name, two nodes, and whether the member is actuated.
    limits
        Of actuated members; without a stroke they have `stroke_factors` times their home length.
    weights
        Of the three nodes of every face.

    Other parameters are as in :class:`vgtm_qp.arm.truss.truss.Truss`.

    Raises
    ------
    TrussError
        A limit is not positive, a home length is outside its stroke, or the joint offsets leave no member.
    """
    names = tuple(member.name for member in members)
    pairs = np.array([member.nodes for member in members], dtype=np.int64)
    actuated = np.array([member.actuated for member in members])
    lengths = np.linalg.norm(home[pairs[:, 0]] - home[pairs[:, 1]], axis=1)
    offset = limits.get("joint_offset", 0.0)
    if not 0.0 <= 2.0 * offset < lengths.min():
        raise TrussError(
            f"joint_offset is {offset:g} m; expected at least 0 and less than half the shortest member, "
            f"{lengths.min() / 2:g} m"
        )
    joints = None
    if offset > 0.0:
        triangle = joint_triangles(node_names, home, pairs, stage)
        joints = axial_joints(home, pairs, triangle, np.full((len(members), 2), offset))
    return Truss(
        module=module,
        node_names=node_names,
        member_names=names,
        home=home,
        base=stage < 0,
        members=pairs,
        actuated=actuated,
        stroke=_strokes(names, lengths - 2.0 * offset, actuated, limits.get("stroke"), stroke_factors),
        rate=_greatest(actuated, limits.get("rate"), "rate"),
        acceleration=_greatest(actuated, limits.get("acceleration"), "acceleration"),
        radius=np.full(len(members), _radius(limits.get("member_radius", 0.03))),
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


def _strokes(
    names: Sequence[str],
    lengths: Array,
    actuated: Mask,
    stroke: Sequence[float] | None,
    factors: tuple[float, float],
) -> Array:
    """(M, 2) least and greatest lengths, m; the home length twice where a member is fixed."""
    strokes = np.column_stack([lengths, lengths])
    if stroke is None:
        strokes[actuated] *= factors
        return strokes
    least, greatest = stroke
    if not 0.0 < least <= greatest:
        raise TrussError(f"stroke is [{least:g}, {greatest:g}] m; expected 0 < least <= greatest")
    strokes[actuated] = least, greatest
    outside = (lengths < strokes[:, 0] - 1e-9) | (lengths > strokes[:, 1] + 1e-9)
    if outside.any():
        k = int(np.argmax(outside))
        raise TrussError(
            f"the home length of member {names[k]}, {lengths[k]:g} m, is outside its stroke "
            f"[{least:g}, {greatest:g}] m"
        )
    return strokes


def _greatest(actuated: Mask, limit: float | None, name: str) -> Array:
    if limit is not None and not limit > 0.0:
        raise TrussError(f"{name} is {limit:g}; expected a number greater than 0")
    return np.where(actuated, np.inf if limit is None else limit, np.inf)


def _radius(radius: float) -> float:
    if not (math.isfinite(radius) and radius >= 0.0):
        raise TrussError(f"member_radius is {radius:g} m; expected a finite radius of at least 0")
    return radius
