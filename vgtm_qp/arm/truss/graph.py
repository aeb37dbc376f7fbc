"""Any truss at all, from tables of nodes and members."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from vgtm_qp.arm.truss.determinacy import check_determinacy, length_jacobian
from vgtm_qp.arm.truss.joints import axial_joints, joint_triangles
from vgtm_qp.arm.truss.mobility import trackable_coordinates
from vgtm_qp.arm.truss.stages import placement_stages
from vgtm_qp.arm.truss.truss import Truss, check_stroke
from vgtm_qp.arrays import Array, Index
from vgtm_qp.errors import TrussError
from vgtm_qp.problem.truss import GraphTruss, Member

_LENGTH_SLACK = 1e-3
"""Relative error up to which positions count as rounded, and are corrected to the given lengths."""


def truss_from_graph(spec: GraphTruss) -> Truss:
    """Build the truss of a ``[truss]`` table with ``module = "graph"``; `locked` is left to the caller.

    Home positions are corrected to the lengths that are given. The joint frame at a node without ``joint``
    is that of :func:`vgtm_qp.arm.truss.joints.joint_triangles`.

    Raises
    ------
    TrussError
        A node does not hang on the base; an actuated member has no stroke, or one that excludes its home
        length; given lengths contradict the positions; the tip or a face lies on one line; the truss is not
        statically determinate.
    """
    index = {node.name: i for i, node in enumerate(spec.node)}
    home = np.array([node.position for node in spec.node], dtype=np.float64)
    base = np.array([node.fixed for node in spec.node])
    pairs = np.array([[index[name] for name in member.nodes] for member in spec.member], dtype=np.int64)
    actuated = np.array([member.actuated for member in spec.member])
    faces = np.array([[index[name] for name in face] for face in spec.faces], dtype=np.int64).reshape(-1, 3)
    _check_connected(spec, base, pairs)

    truss = Truss(
        module="graph",
        node_names=tuple(index),
        member_names=tuple(member.name for member in spec.member),
        home=home,
        base=base,
        members=pairs,
        actuated=actuated,
        stroke=np.zeros((len(pairs), 2)),
        rate=_limits(actuated, [member.rate for member in spec.member], spec.rate),
        acceleration=_limits(actuated, [member.acceleration for member in spec.member], spec.acceleration),
        radius=np.array(
            [spec.member_radius if member.radius is None else member.radius for member in spec.member]
        ),
        faces=faces,
        face_weights=np.full((len(faces), 3), 1 / 3),
        face_frames=np.zeros((len(faces), 3, 3)),
        tip=np.array([index[name] for name in spec.tip], dtype=np.int64),
        tip_weights=np.full(len(spec.tip), 1 / len(spec.tip)),
        tip_frame=np.eye(3),
        stage=np.where(base, -1, 0),
    )
    check_determinacy(truss)
    truss = dataclasses.replace(truss, home=_corrected_home(spec, truss))
    truss = _with_frames(_with_stages_and_joints(spec, truss))
    if truss.joints is not None:
        check_determinacy(truss)
    truss = dataclasses.replace(truss, stroke=_strokes(spec, truss))
    return dataclasses.replace(truss, trackable=trackable_coordinates(truss))


def _check_connected(spec: GraphTruss, base: Array, pairs: Index) -> None:
    given = np.flatnonzero(base)
    links = np.vstack([pairs, np.column_stack([given[:-1], given[1:]])])
    count = len(base)
    graph = sparse.csr_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(count, count))
    _, component = connected_components(graph, directed=False)
    loose = np.flatnonzero(component != component[given[0]])
    if len(loose):
        names = ", ".join(spec.node[i].name for i in loose[:8])
        more = f" and {len(loose) - 8} more" if len(loose) > 8 else ""
        raise TrussError(f"no chain of members joins node(s) {names}{more} to the base")


def _limits(actuated: Array, own: Sequence[float | None], common: float | None) -> Array:
    everywhere = np.inf if common is None else common
    limits = np.array([everywhere if limit is None else limit for limit in own])
    return np.where(actuated, limits, np.inf)


def _corrected_home(spec: GraphTruss, truss: Truss) -> Array:
    """Return home positions (N, 3) with the given member lengths, by Newton on the node distances."""
    home = truss.home.copy()
    distances = _distances(truss, home)
    goal = distances.copy()
    for k, member in enumerate(spec.member):
        if member.length is not None and member.offsets is None:
            goal[k] = member.length + 2.0 * spec.joint_offset
            if abs(goal[k] - distances[k]) > _LENGTH_SLACK * distances[k]:
                raise _contradiction(member, distances[k] - 2.0 * spec.joint_offset)
    for _ in range(20):
        error = goal - _distances(truss, home)
        if np.abs(error).max() <= 1e-13 * goal.max():
            break
        home[truss.free] += splu(length_jacobian(truss, home)).solve(error).reshape(-1, 3)
    if np.abs(home - truss.home).max() > 0.1 * distances.max() or np.abs(error).max() > 1e-11 * goal.max():
        raise TrussError(
            "the given lengths and positions do not fit together: no pose nearby has these lengths"
        )
    return home


def _contradiction(member: Member, length: float) -> TrussError:
    return TrussError(
        f"member {member.name} has the length {member.length:g} m, "
        f"but the positions of its nodes give {length:g} m"
    )


def _distances(truss: Truss, X: Array) -> Array:
    return np.asarray(np.linalg.norm(X[truss.members[:, 0]] - X[truss.members[:, 1]], axis=1))


def _with_stages_and_joints(spec: GraphTruss, truss: Truss) -> Truss:
    stage = placement_stages(truss.base, truss.members)
    if spec.joint_offset == 0.0 and all(member.offsets is None for member in spec.member):
        return dataclasses.replace(truss, stage=stage)
    names = truss.node_names
    index = {name: i for i, name in enumerate(names)}
    chosen = {i: tuple(index[name] for name in node.joint) for i, node in enumerate(spec.node) if node.joint}
    triangle = joint_triangles(names, truss.home, truss.members, stage, chosen)
    offset = np.full((truss.member_count, 2), spec.joint_offset)
    joints = axial_joints(truss.home, truss.members, triangle, offset)
    for k, member in enumerate(spec.member):
        if member.offsets is not None:
            joints.offset[k] = member.offsets
    # A triangle that a table names may reach into later stages, which then have to be placed together.
    reach = np.hstack([truss.members, triangle[truss.members].reshape(-1, 6)])
    return dataclasses.replace(truss, stage=placement_stages(truss.base, reach), joints=joints)


def _with_frames(truss: Truss) -> Truss:
    """Return the truss with home frames: z the normal away from the face before, x towards the first node."""
    centres = truss.home[truss.faces].mean(axis=1)
    tip_centre = truss.home[truss.tip].mean(axis=0)
    root = truss.home[truss.base].mean(axis=0)
    steps = np.diff(centres, axis=0)
    onward = np.vstack([steps[:1] if len(steps) else tip_centre - root, steps])[: len(centres)]
    frames = [_polygon_frame(truss, face, away) for face, away in zip(truss.faces, onward, strict=True)]
    tip, tip_frame = truss.tip, np.eye(3)
    if len(tip) >= 3:
        at_last_face = len(truss.faces) > 0 and set(tip) == set(truss.faces[-1])
        tip_frame = frames[-1] if at_last_face else _polygon_frame(truss, tip, tip_centre - root)
        tip = tip[_around(truss.home[tip], tip_frame)]
    if truss.base[tip].all():
        raise TrussError("every node of the tip is fixed; expected at least one that can move")
    return dataclasses.replace(
        truss, tip=tip, tip_frame=tip_frame, face_frames=np.array(frames).reshape(-1, 3, 3)
    )


def _polygon_frame(truss: Truss, nodes: Index, away: Array) -> Array:
    """Return the (3, 3) frame of the plane through `nodes`, z on the side of `away`."""
    centred = truss.home[nodes] - truss.home[nodes].mean(axis=0)
    _, spread, axes = np.linalg.svd(centred)
    if spread[1] <= 1e-6 * spread[0]:
        names = ", ".join(truss.node_names[i] for i in nodes)
        raise TrussError(f"nodes {names} lie on one line and have no normal; expected a triangle")
    z = axes[2] if axes[2] @ away >= 0.0 else -axes[2]
    # If the first node is the centre itself, x lies along the longest extent of the polygon.
    x = centred[0] - z * (z @ centred[0])
    x = x if np.linalg.norm(x) > 1e-6 * spread[0] else axes[0]
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _around(points: Array, frame: Array) -> Index:
    """Return the order of `points` counter-clockwise about z of `frame`, from the first one."""
    local = (points - points.mean(axis=0)) @ frame
    angle = np.arctan2(local[:, 1], local[:, 0])
    turn = np.mod(angle - angle[0], 2 * np.pi)
    turn[turn > 2 * np.pi - 1e-9] = 0.0
    return np.argsort(turn, kind="stable")


def _strokes(spec: GraphTruss, truss: Truss) -> Array:
    """(M, 2) least and greatest lengths, m; the home length twice where a member is fixed."""
    lengths = truss.home_lengths
    strokes = np.column_stack([lengths, lengths])
    for k, member in enumerate(spec.member):
        if member.length is not None and abs(lengths[k] - member.length) > 1e-9 * max(1.0, member.length):
            raise _contradiction(member, lengths[k])
        if not member.actuated:
            continue
        stroke = member.stroke or spec.stroke
        if stroke is None:
            raise TrussError(
                f"actuated member {member.name} has no stroke; expected one of its own or of the truss"
            )
        check_stroke(member.name, lengths[k], stroke)
        strokes[k] = stroke
    return strokes
