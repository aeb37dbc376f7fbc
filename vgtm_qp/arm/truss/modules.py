"""The trusses of the paper from their tables: modules that are stacked along +z of the base frame.

In a stack a name is a kind, a layer of nodes (0 is the base) and a place in it (from 1): node ``n0-1``, batten
``B4-1``, longeron or leg ``L3-2``, diagonal ``D2-1``. Lengths of a table are distances between nodes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from vgtm_qp.arm.truss.joints import axial_joints, joint_triangles
from vgtm_qp.arm.truss.truss import Truss, check_stroke
from vgtm_qp.arrays import Array, Index
from vgtm_qp.errors import TrussError
from vgtm_qp.problem.truss import ModuleTruss, TetrahedralTruss

_POSE = ("position", "pointing", "orientation")


class MemberRow(NamedTuple):
    """A member before its truss: name, indices of its two nodes, and whether it changes its length."""

    name: str
    nodes: tuple[int, int]
    actuated: bool


class _Module(NamedTuple):
    """What differs between modules of triangular layers; for the last two fields see ``Truss``."""

    longerons: bool
    """Whether the members between two layers are actuated (but for diagonals)."""
    battens: tuple[bool, ...]
    """Whether the battens of each layer of a bay are actuated."""
    stroke: tuple[float, float]
    """Least and greatest length of an actuated member over its home length, where a table gives no stroke."""
    trackable: tuple[str, ...]
    face_stride: int = 1


_MODULES = {
    # Three free motions a bay. Between equal faces a bay is sqrt(L^2 - b^2 / 3) high.
    "octahedral": _Module(False, (True,), (0.6, 1.5), ("position",)),
    # Three free motions a bay of two layers; the arm's faces are the rigid ones.
    "double-octahedral": _Module(False, (True, False), (0.6, 1.5), ("position",)),
    # Rigid faces joined by six legs: six free motions a bay.
    "hexapod": _Module(True, (False,), (0.7, 1.4), _POSE),
    # Rigid faces, longerons and fixed diagonals: three free motions a bay.
    "longeron": _Module(True, (False,), (0.6, 1.4), _POSE, face_stride=2),
}


def stacked(spec: ModuleTruss) -> Truss:
    """Return octahedral, double-octahedral, hexapod or longeron bays; each layer of three nodes is a stage.

    Raises
    ------
    TrussError
        A home length is outside its stroke, or the joint offsets leave no member.
    """
    module = _MODULES[spec.module]
    per_bay = len(module.battens)
    layers, is_prism = spec.bays * per_bay, spec.module == "longeron"
    members: list[MemberRow] = []
    for layer in range(1, layers + 1):
        members += _prism(layer) if is_prism else _antiprism(layer, actuated=module.longerons)
        members += _battens(layer, actuated=module.battens[(layer - 1) % per_bay])
    turn, height = 0.0, spec.longeron
    if not is_prism:
        turn, height = math.pi / 3.0, math.sqrt(spec.longeron**2 - spec.batten**2 / 3.0)
    home = np.vstack([_triangle(spec.batten, (k % 2) * turn, k * height) for k in range(layers + 1)])
    nodes = np.arange(len(home))
    return _assemble(
        spec,
        _layer_names(len(home)),
        home,
        nodes // 3 - 1,
        members,
        module.stroke,
        faces=nodes.reshape(-1, 3)[::per_bay],
        trackable=module.trackable,
        face_stride=module.face_stride,
    )


def tetrahedral(spec: TetrahedralTruss) -> Truss:
    """Return tetrahedra face on face (Boerdijk-Coxeter helix): each node hangs by three members on the three before.

    A bay is three nodes, and every node is a stage of its own. Members (i, i-1) and (i, i-2) are the battens
    ``B`` and ``D``, members (i, i-3) the longerons ``L``. The home pose is a helix about z, theta its turn a
    node, cos theta = -1/2 - L^2 / (6 b^2). Three successive nodes with the weights w, 1 - 2 w, w, where
    w = 1 / (2 (1 - cos theta)), have their mean on its axis (w = 0.3 where L = b). No face, not even the
    base, is normal to the axis; the base's point on the axis is the origin.

    Raises
    ------
    TrussError
        A home length is outside its stroke, or the joint offsets leave no member.
    """
    home, cosine = _helix(3 * (spec.bays + 1), spec.longeron, spec.batten)
    members = [
        MemberRow(f"{kind}{i // 3}-{i % 3 + 1}", (i - k, i), k in spec.actuated)
        for i in range(3, len(home))
        for k, kind in ((1, "B"), (2, "D"), (3, "L"))
    ]
    weight = 1.0 / (2.0 * (1.0 - cosine))
    nodes = np.arange(len(home))
    return _assemble(
        spec,
        _layer_names(len(home)),
        home,
        np.maximum(nodes - 3, -1),
        members,
        (0.75, 1.3),
        faces=nodes.reshape(-1, 3),
        weights=(weight, 1.0 - 2.0 * weight, weight),
        trackable=_POSE if len(spec.actuated) > 1 else ("position",),
    )


def _layer_names(count: int) -> tuple[str, ...]:
    return tuple(f"n{i // 3}-{i % 3 + 1}" for i in range(count))


def _triangle(batten: float, angle: float, z: float) -> Array:
    """Equilateral triangle of side `batten`, (3, 3), counter-clockwise, its first node at `angle` about z."""
    angles = angle + np.arange(3) * (2.0 * math.pi / 3.0)
    radius = batten / math.sqrt(3.0)
    return np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.full(3, z)])


def _helix(count: int, longeron: float, batten: float) -> tuple[Array, float]:
    """Return `count` nodes of the helix about z, the second one at z = 0, and the cosine of its turn a node.

    A helix of radius r and rise d has 2 r^2 (1 - cos k theta) + (k d)^2 between nodes i and i - k: `batten`
    squared for k = 1 and 2, `longeron` squared for k = 3.
    """
    cosine = -0.5 - longeron**2 / (6.0 * batten**2)
    chord_squared = 1.5 * batten**2 / (1.0 - cosine)
    radius = math.sqrt(chord_squared / (2.0 * (1.0 - cosine)))
    rise = math.sqrt(batten**2 - chord_squared)
    steps = np.arange(count)
    angles = steps * math.acos(cosine)
    return np.column_stack([radius * np.cos(angles), radius * np.sin(angles), (steps - 1) * rise]), cosine


def _antiprism(layer: int, *, actuated: bool) -> Iterator[MemberRow]:
    """Yield the six members of an antiprism between `layer` and the layer below it."""
    # Odd layers are turned by 60 degrees: node i stands between nodes i and i+1 below. Even layers turn back.
    other = 1 if layer % 2 else 2
    pairs = [(i, (i + shift) % 3) for i in range(3) for shift in (0, other)]
    for place, (i, below) in enumerate(pairs, start=1):
        yield MemberRow(f"L{layer}-{place}", (3 * (layer - 1) + below, 3 * layer + i), actuated)


def _prism(layer: int) -> Iterator[MemberRow]:
    """Yield three actuated longerons and three fixed diagonals between `layer` and the layer below it.

    The hand of the diagonals alternates from bay to bay: with one hand alone, extension would twist the arm
    by 3.5 rad per unit of height, and two bays could not meet all six coordinates of a face.
    """
    below, above, hand = 3 * (layer - 1), 3 * layer, 1 if layer % 2 else 2
    for i in range(3):
        yield MemberRow(f"L{layer}-{i + 1}", (below + i, above + i), True)
    for i in range(3):
        yield MemberRow(f"D{layer}-{i + 1}", (below + i, above + (i + hand) % 3), False)


def _battens(layer: int, *, actuated: bool) -> Iterator[MemberRow]:
    for i in range(3):
        yield MemberRow(f"B{layer}-{i + 1}", (3 * layer + i, 3 * layer + (i + 1) % 3), actuated)


def _assemble(
    spec: ModuleTruss | TetrahedralTruss,
    node_names: tuple[str, ...],
    home: Array,
    stage: Index,
    members: Sequence[MemberRow],
    stroke_factors: tuple[float, float],
    *,
    faces: Index,
    trackable: tuple[str, ...],
    weights: Sequence[float] = (1 / 3, 1 / 3, 1 / 3),
    face_stride: int = 1,
) -> Truss:
    """Return the truss of a table, whose face and tip frames at home are those of the base.

    Without a stroke in the table, actuated members are `stroke_factors` times their home lengths, least and greatest.
    The tip is the last face; every face has the same `weights`.
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
        face_weights=np.resize(np.asarray(weights, dtype=np.float64), faces.shape),
        face_frames=np.tile(np.eye(3), (len(faces), 1, 1)),
        tip=faces[-1],
        tip_weights=np.asarray(weights, dtype=np.float64),
        tip_frame=np.eye(3),
        stage=stage,
        trackable=trackable,
        face_stride=face_stride,
        joints=joints,
    )
