"""Offset joints: which triangle orients the joint at each node, where members end in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from vgtm_qp.arrays import Array, Index
from vgtm_qp.errors import TrussError
from vgtm_qp.rows.members import joint_frames

_LEAST_SINE = 0.1
"""A triangle with a smaller sine at the node does not orient a joint: its normal would turn too fast."""


@dataclass(frozen=True, eq=False)
class Joints:
    """Offset joints: where each member's two ends stand in the frames of their nodes' joints.

    Attributes
    ----------
    triangle : (N, 3) int
        Joint frame of node i: origin at node ``triangle[i, 0]`` (= i), z along the normal of the three nodes in
        counter-clockwise order, x along the outward bisector at node i.
    offset : (M, 2, 3)
        Constant position of each member's two ends in those frames, m.
    """

    triangle: Index
    offset: Array


def axial_joints(home: Array, members: Index, triangle: Index, offset: Array) -> Joints:
    """Return joints whose members end `offset` (M, 2), m, from their nodes, on the members' axes at home."""
    way = home[members[:, 1]] - home[members[:, 0]]
    direction = way / np.linalg.norm(way, axis=1, keepdims=True)
    outward = np.stack([direction, -direction], axis=1) * offset[:, :, None]
    frames = joint_frames(home, triangle)
    return Joints(triangle, np.einsum("mexy,mex->mey", frames[members], outward))


def joint_triangles(
    node_names: Sequence[str],
    home: Array,
    members: Index,
    stage: Index,
    chosen: Mapping[int, tuple[int, ...]] | None = None,
) -> Index:
    """Return (N, 3) the nodes whose triangle orients each node's joint, the node itself first.

    The two others are neighbours of the same or an earlier stage, so that no member's length depends on a
    later stage. Neighbours of the node's own stage come first, then the triangle with the largest sine. For some nodes
    the two others are `chosen`, counter-clockwise about z.

    Raises
    ------
    TrussError
        A node has no two such neighbours off one line, or a chosen triangle lies on one.
    """
    neighbours: list[set[int]] = [set() for _ in node_names]
    for i, j in members.tolist():
        neighbours[i].add(j)
        neighbours[j].add(i)
    base = np.flatnonzero(stage < 0).tolist()
    for i in base:
        neighbours[i].update(base)
    triangle = np.empty((len(node_names), 3), dtype=np.int64)
    for i, around in enumerate(neighbours):
        if chosen and i in chosen:
            triangle[i] = (i, *chosen[i])
            if _normal(home, *triangle[i].tolist())[1] < _LEAST_SINE:
                names = ", ".join(node_names[j] for j in triangle[i])
                raise TrussError(f"the joint at node {node_names[i]}: {names} are nearly on one line")
            continue
        earlier = sorted(j for j in around if j != i and stage[j] <= stage[i])
        best: tuple[int, float, int] | None = None
        for a, b in combinations(earlier, 2):
            normal, sine = _normal(home, i, a, b)
            rank = (int(stage[a] + stage[b]), round(sine, 9), -min(a, b))
            if sine < _LEAST_SINE or (best is not None and rank <= best):
                continue
            best = rank
            upward = normal @ (home[i] - home[stage < 0].mean(axis=0)) if stage[i] >= 0 else normal[2]
            triangle[i] = (i, a, b) if upward >= -1e-9 else (i, b, a)
        if best is None:
            raise TrussError(
                f"the joint at node {node_names[i]} has no orientation: none of its earlier neighbours "
                f"{', '.join(node_names[j] for j in earlier)} make a triangle with it"
            )
    return triangle


def _normal(home: Array, i: int, a: int, b: int) -> tuple[Array, float]:
    """Return the normal of the triangle (i, a, b) at node i, of length |sine|, and that sine."""
    first, second = home[a] - home[i], home[b] - home[i]
    normal = np.cross(first, second) / (np.linalg.norm(first) * np.linalg.norm(second))
    return normal, float(np.linalg.norm(normal))
