"""The periodic trusses of the paper: each builder stacks one module along +z of the base frame.

A name is a kind, a layer of nodes (0 is the base) and a place in it (from 1): node ``n0-1``, batten ``B4-1``,
longeron or leg ``L3-2``, diagonal ``D2-1``. Lengths given here are distances between nodes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from vgtm_qp.errors import TrussError
from vgtm_qp.truss.truss import Array, Truss

Limits = Sequence[float]
"""Least and greatest length of an actuated member, m."""


class _Member(NamedTuple):
    name: str
    nodes: tuple[int, int]
    actuated: bool


class _Actuators(NamedTuple):
    """What is the same for every actuated member, and the radius of all members."""

    stroke: Limits | None
    default_stroke: tuple[float, float]
    rate: float | None
    acceleration: float | None
    member_radius: float


def octahedral(
    bays: int,
    *,
    longeron: float = 1.0,
    batten: float = 1.0,
    stroke: Limits | None = None,
    rate: float | None = None,
    acceleration: float | None = None,
    member_radius: float = 0.03,
) -> Truss:
    """Octahedral bays: six fixed longerons to the face below, three actuated battens, three free motions a bay.

    The height of a bay between equal faces is sqrt(L^2 - b^2 / 3) for longeron L and batten b.

    Parameters
    ----------
    bays : int
        Number of bays, at least 1.
    longeron, batten : float
        Home lengths, m; batten < sqrt(3) longeron.
    stroke : pair of float, optional
        Least and greatest length of a batten, m; 0.6 and 1.5 times the home length if not given.
    rate, acceleration : float, optional
        Limits of an actuated member, m/s and m/s^2; none if not given.
    member_radius : float
        Radius of every member, m.

    Raises
    ------
    TrussError
        A dimension is not positive, the bay would be flat, or the home length is outside the stroke.
    """
    actuators = _Actuators(stroke, (0.6, 1.5), rate, acceleration, member_radius)
    _check_dimensions(bays, longeron=longeron, batten=batten)
    home = _antiprism_nodes(bays, longeron, batten)
    members = [
        member
        for layer in range(1, bays + 1)
        for member in (*_zigzag(layer, "L", False), *_battens(layer, actuated=True))
    ]
    return _layered("octahedral", home, members, actuators, bays=bays, trackable=("position",))


def _check_dimensions(bays: int, **lengths: float) -> None:
    if bays < 1:
        raise TrussError(f"a truss has at least one bay, not {bays}")
    for name, length in lengths.items():
        if not (math.isfinite(length) and length > 0.0):
            raise TrussError(f"{name} is {length:g} m; expected a finite length greater than 0")


def _triangle(batten: float, angle: float, z: float) -> Array:
    """Equilateral triangle of side `batten`, (3, 3), counter-clockwise, its first node at `angle` about z."""
    angles = angle + np.arange(3) * (2.0 * math.pi / 3.0)
    radius = batten / math.sqrt(3.0)
    return np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.full(3, z)])


def _antiprism_nodes(layers: int, side: float, batten: float) -> Array:
    """Triangles turned by 60 degrees at every second layer, each node at `side` from two nodes below."""
    height_squared = side**2 - batten**2 / 3.0
    if height_squared <= 1e-9 * side**2:
        raise TrussError(
            f"batten {batten:g} m and side member {side:g} m make a flat bay; "
            f"expected batten < sqrt(3) times the side member = {math.sqrt(3.0) * side:g} m"
        )
    height = math.sqrt(height_squared)
    return np.vstack([_triangle(batten, (k % 2) * math.pi / 3.0, k * height) for k in range(layers + 1)])


def _zigzag(layer: int, kind: str, actuated: bool) -> Iterator[_Member]:
    """Yield the six members of an antiprism between `layer` and the layer below it."""
    # Odd layers are turned by 60 degrees: node i stands between nodes i and i+1 below. Even layers turn back.
    other = 1 if layer % 2 else 2
    pairs = [(i, (i + shift) % 3) for i in range(3) for shift in (0, other)]
    for place, (i, below) in enumerate(pairs, start=1):
        yield _Member(f"{kind}{layer}-{place}", (3 * (layer - 1) + below, 3 * layer + i), actuated)


def _battens(layer: int, *, actuated: bool) -> Iterator[_Member]:
    for i in range(3):
        yield _Member(f"B{layer}-{i + 1}", (3 * layer + i, 3 * layer + (i + 1) % 3), actuated)


def _layered(
    module: str,
    home: Array,
    members: Sequence[_Member],
    actuators: _Actuators,
    *,
    bays: int,
    trackable: tuple[str, ...],
    layers_per_bay: int = 1,
    weights: Sequence[float] = (1 / 3, 1 / 3, 1 / 3),
    stage: Array | None = None,
) -> Truss:
    """Assemble a truss whose nodes come in layers of three; a face ends each bay, parallel to the base."""
    nodes = np.arange(len(home))
    layer = nodes // 3
    faces = nodes.reshape(-1, 3)[::layers_per_bay]
    pairs = np.array([member.nodes for member in members], dtype=np.int64)
    actuated = np.array([member.actuated for member in members])
    lengths = np.linalg.norm(home[pairs[:, 0]] - home[pairs[:, 1]], axis=1)
    return Truss(
        module=module,
        node_names=tuple(f"n{k}-{i + 1}" for k, i in zip(layer, nodes % 3, strict=True)),
        member_names=tuple(member.name for member in members),
        home=home,
        base=layer == 0,
        members=pairs,
        actuated=actuated,
        stroke=_strokes([member.name for member in members], lengths, actuated, actuators),
        rate=_limit(actuated, actuators.rate, "rate"),
        acceleration=_limit(actuated, actuators.acceleration, "acceleration"),
        radius=_radii(len(members), actuators.member_radius),
        faces=faces,
        face_weights=np.tile(np.asarray(weights, dtype=np.float64), (len(faces), 1)),
        face_frames=np.tile(np.eye(3), (len(faces), 1, 1)),
        tip=faces[-1],
        tip_weights=np.asarray(weights, dtype=np.float64),
        tip_frame=np.eye(3),
        stage=layer - 1 if stage is None else stage,
        bays=bays,
        trackable=trackable,
    )


def _strokes(names: Sequence[str], lengths: Array, actuated: Array, actuators: _Actuators) -> Array:
    """(M, 2) least and greatest lengths, m; the home length twice where a member is fixed."""
    strokes = np.column_stack([lengths, lengths])
    if actuators.stroke is None:
        strokes[actuated] *= actuators.default_stroke
    else:
        least, greatest = actuators.stroke
        if not 0.0 < least <= greatest:
            raise TrussError(f"stroke is [{least:g}, {greatest:g}] m; expected 0 < least <= greatest")
        strokes[actuated] = least, greatest
    outside = (lengths < strokes[:, 0] - 1e-9) | (lengths > strokes[:, 1] + 1e-9)
    if outside.any():
        k = int(np.argmax(outside))
        raise TrussError(
            f"home length {lengths[k]:g} m of member {names[k]} is outside its stroke "
            f"[{strokes[k, 0]:g}, {strokes[k, 1]:g}] m"
        )
    return strokes


def _limit(actuated: Array, limit: float | None, name: str) -> Array:
    if limit is not None and not limit > 0.0:
        raise TrussError(f"{name} is {limit:g}; expected a number greater than 0")
    return np.where(actuated, np.inf if limit is None else limit, np.inf)


def _radii(count: int, radius: float) -> Array:
    if not (math.isfinite(radius) and radius >= 0.0):
        raise TrussError(f"member_radius is {radius:g} m; expected a finite radius of at least 0")
    return np.full(count, radius)
