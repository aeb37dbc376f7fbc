"""The periodic trusses of the paper: each builder stacks one module along +z of the base frame.

A name is a kind, a layer of nodes (0 is the base) and a place in it (from 1): node ``n0-1``, batten ``B4-1``,
longeron or leg ``L3-2``, diagonal ``D2-1``. Lengths given here are distances between nodes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Unpack

import numpy as np

from vgtm_qp.arm.truss.assembly import Limits, MemberRow, assemble
from vgtm_qp.arm.truss.truss import Array, Index, Truss
from vgtm_qp.errors import TrussError


def octahedral(bays: int, *, longeron: float = 1.0, batten: float = 1.0, **limits: Unpack[Limits]) -> Truss:
    """Octahedral bays: six fixed longerons to the face below and three actuated battens, three free motions.

    The height of a bay between equal faces is sqrt(L^2 - b^2 / 3) for longeron L and batten b.

    Parameters
    ----------
    bays : int
        Number of bays, at least 1.
    longeron, batten : float
        Home lengths, m; batten < sqrt(3) longeron.
    **limits
        See :class:`Limits`; the stroke of a batten is 0.6 to 1.5 times its home length where not given.

    Raises
    ------
    TrussError
        A dimension is not positive, the bay would be flat, or a home length is outside its stroke.
    """
    _check_dimensions(bays, longeron=longeron, batten=batten)
    members: list[MemberRow] = []
    for layer in range(1, bays + 1):
        members += [*_zigzag(layer, actuated=False), *_battens(layer, actuated=True)]
    home = _antiprism(bays, longeron, batten)
    return _stacked("octahedral", home, members, limits, (0.6, 1.5), trackable=("position",))


def double_octahedral(
    bays: int, *, longeron: float = 1.0, batten: float = 1.0, **limits: Unpack[Limits]
) -> Truss:
    """Double octahedral bays: two octahedral layers, the middle face actuated, the end face rigid.

    Three free motions a double bay; the arm's faces are the rigid ones. Layers 2k - 1 and 2k belong to bay k.
    Each layer is a stage of its own: six longerons and three battens place its three nodes.

    Parameters
    ----------
    bays : int
        Number of double bays, at least 1.
    longeron, batten : float
        Home lengths, m; batten < sqrt(3) longeron.
    **limits
        See :class:`Limits`; the stroke of a middle batten is 0.6 to 1.5 times its home length if not given.

    Raises
    ------
    TrussError
        As :func:`octahedral`.
    """
    _check_dimensions(bays, longeron=longeron, batten=batten)
    members: list[MemberRow] = []
    for layer in range(1, 2 * bays + 1):
        members += [*_zigzag(layer, actuated=False), *_battens(layer, actuated=layer % 2 == 1)]
    home = _antiprism(2 * bays, longeron, batten)
    return _stacked(
        "double-octahedral", home, members, limits, (0.6, 1.5), trackable=("position",), layers_per_bay=2
    )


def hexapod(bays: int, *, longeron: float = 1.0, batten: float = 1.0, **limits: Unpack[Limits]) -> Truss:
    """Hexapod bays: rigid faces joined by six actuated legs, six free motions each.

    Parameters
    ----------
    bays : int
        Number of bays, at least 1.
    longeron, batten : float
        Home length of a leg and length of a side of a face, m; batten < sqrt(3) longeron.
    **limits
        See :class:`Limits`; the stroke of a leg is 0.7 to 1.4 times its home length where not given.

    Raises
    ------
    TrussError
        As :func:`octahedral`.
    """
    _check_dimensions(bays, longeron=longeron, batten=batten)
    members: list[MemberRow] = []
    for layer in range(1, bays + 1):
        members += [*_zigzag(layer, actuated=True), *_battens(layer, actuated=False)]
    home = _antiprism(bays, longeron, batten)
    trackable = ("position", "pointing", "orientation")
    return _stacked("hexapod", home, members, limits, (0.7, 1.4), trackable=trackable)


def longeron(bays: int, *, longeron: float = 1.0, batten: float = 1.0, **limits: Unpack[Limits]) -> Truss:
    """Prismatic bays: three actuated longerons, three fixed diagonals and a rigid face, three free motions.

    The hand of the diagonals alternates from bay to bay: with one hand alone, extension would twist the arm
    by 3.5 rad per unit of height, and two bays could not meet all six coordinates of a face.

    Parameters
    ----------
    bays : int
        Number of bays, at least 1.
    longeron, batten : float
        Home length of a longeron and length of a side of a face, m.
    **limits
        See :class:`Limits`; the stroke of a longeron is 0.6 to 1.4 times its home length where not given.

    Raises
    ------
    TrussError
        A dimension is not positive or a home length is outside its stroke.
    """
    _check_dimensions(bays, longeron=longeron, batten=batten)
    members: list[MemberRow] = []
    for layer in range(1, bays + 1):
        below, above = 3 * (layer - 1), 3 * layer
        hand = 1 if layer % 2 else 2
        members += [MemberRow(f"L{layer}-{i + 1}", (below + i, above + i), True) for i in range(3)]
        members += [
            MemberRow(f"D{layer}-{i + 1}", (below + i, above + (i + hand) % 3), False) for i in range(3)
        ]
        members += _battens(layer, actuated=False)
    home = np.vstack([_triangle(batten, 0.0, layer * longeron) for layer in range(bays + 1)])
    trackable = ("position", "pointing", "orientation")
    return _stacked("longeron", home, members, limits, (0.6, 1.4), trackable=trackable, face_stride=2)


def tetrahedral(
    bays: int,
    *,
    longeron: float = 1.0,
    batten: float = 1.0,
    actuated: Sequence[int] = (1, 2, 3),
    **limits: Unpack[Limits],
) -> Truss:
    """Tetrahedra face on face (Boerdijk-Coxeter helix): each node hangs by three members on the three before.

    A bay is three nodes, and every node is a stage of its own. Members (i, i-1) and (i, i-2) are the battens
    ``B`` and ``D``, members (i, i-3) the longerons ``L``. The home pose is a helix about z, theta its turn a
    node, cos theta = -1/2 - L^2 / (6 b^2). Three successive nodes with the weights w, 1 - 2 w, w, where
    w = 1 / (2 (1 - cos theta)), have their mean on its axis (w = 0.3 where L = b). No face is normal to the
    axis, the base neither: its axis point is the origin.

    Parameters
    ----------
    bays : int
        Number of bays of three nodes, at least 1.
    longeron, batten : float
        Home length of members (i, i-3), and of members (i, i-1) and (i, i-2), m;
        longeron < sqrt(3) batten.
    actuated : sequence of int
        Which k of the members (i, i-k) are actuated: three, six or nine free motions a bay.
    **limits
        See :class:`Limits`; the stroke is 0.75 to 1.3 times the home length where not given.

    Raises
    ------
    TrussError
        A dimension is not positive, the longeron is too long for a helix, `actuated` is not one to three of
        the numbers 1, 2, 3, or a home length is outside its stroke.
    """
    _check_dimensions(bays, longeron=longeron, batten=batten)
    if not actuated or len(set(actuated)) < len(actuated) or not set(actuated) <= {1, 2, 3}:
        raise TrussError(f"actuated is {list(actuated)}; expected one to three different numbers of 1, 2, 3")
    home, cosine = _helix(3 * (bays + 1), longeron, batten)
    members = [
        MemberRow(f"{kind}{i // 3}-{i % 3 + 1}", (i - k, i), k in actuated)
        for i in range(3, len(home))
        for k, kind in ((1, "B"), (2, "D"), (3, "L"))
    ]
    weight = 1.0 / (2.0 * (1.0 - cosine))
    return _stacked(
        "tetrahedral",
        home,
        members,
        limits,
        (0.75, 1.3),
        trackable=("position", "pointing", "orientation") if len(actuated) > 1 else ("position",),
        weights=(weight, 1.0 - 2.0 * weight, weight),
        stage=np.maximum(np.arange(len(home)) - 3, -1),
    )


def _check_dimensions(bays: int, **lengths: float) -> None:
    if bays < 1:
        raise TrussError(f"bays is {bays}; expected at least 1")
    for name, length in lengths.items():
        if not (math.isfinite(length) and length > 0.0):
            raise TrussError(f"{name} is {length:g} m; expected a finite length greater than 0")


def _triangle(batten: float, angle: float, z: float) -> Array:
    """Equilateral triangle of side `batten`, (3, 3), counter-clockwise, its first node at `angle` about z."""
    angles = angle + np.arange(3) * (2.0 * math.pi / 3.0)
    radius = batten / math.sqrt(3.0)
    return np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.full(3, z)])


def _antiprism(layers: int, side: float, batten: float) -> Array:
    """Triangles turned by 60 degrees at every second layer, each node at `side` from two nodes below."""
    height_squared = side**2 - batten**2 / 3.0
    if height_squared <= 1e-9 * side**2:
        raise TrussError(
            f"batten is {batten:g} m: the bay folds flat; expected less than sqrt(3) times the longeron, "
            f"{math.sqrt(3.0) * side:g} m"
        )
    height = math.sqrt(height_squared)
    return np.vstack([_triangle(batten, (k % 2) * math.pi / 3.0, k * height) for k in range(layers + 1)])


def _helix(count: int, longeron: float, batten: float) -> tuple[Array, float]:
    """Return `count` nodes of the helix about z, the second one at z = 0, and the cosine of its turn a node.

    A helix of radius r and rise d has 2 r^2 (1 - cos k theta) + (k d)^2 between nodes i and i - k: `batten`
    squared for k = 1 and 2, `longeron` squared for k = 3.
    """
    cosine = -0.5 - longeron**2 / (6.0 * batten**2)
    if cosine <= -1.0 + 1e-9:
        raise TrussError(
            f"longeron is {longeron:g} m: the helix folds flat; expected less than sqrt(3) times the batten, "
            f"{math.sqrt(3.0) * batten:g} m"
        )
    chord_squared = 1.5 * batten**2 / (1.0 - cosine)
    radius = math.sqrt(chord_squared / (2.0 * (1.0 - cosine)))
    rise = math.sqrt(batten**2 - chord_squared)
    steps = np.arange(count)
    angles = steps * math.acos(cosine)
    return np.column_stack([radius * np.cos(angles), radius * np.sin(angles), (steps - 1) * rise]), cosine


def _zigzag(layer: int, *, actuated: bool) -> Iterator[MemberRow]:
    """Yield the six members of an antiprism between `layer` and the layer below it."""
    # Odd layers are turned by 60 degrees: node i stands between nodes i and i+1 below. Even layers turn back.
    other = 1 if layer % 2 else 2
    pairs = [(i, (i + shift) % 3) for i in range(3) for shift in (0, other)]
    for place, (i, below) in enumerate(pairs, start=1):
        yield MemberRow(f"L{layer}-{place}", (3 * (layer - 1) + below, 3 * layer + i), actuated)


def _battens(layer: int, *, actuated: bool) -> Iterator[MemberRow]:
    for i in range(3):
        yield MemberRow(f"B{layer}-{i + 1}", (3 * layer + i, 3 * layer + (i + 1) % 3), actuated)


def _stacked(
    module: str,
    home: Array,
    members: Sequence[MemberRow],
    limits: Limits,
    stroke_factors: tuple[float, float],
    *,
    trackable: tuple[str, ...],
    layers_per_bay: int = 1,
    face_stride: int = 1,
    weights: Sequence[float] = (1 / 3, 1 / 3, 1 / 3),
    stage: Index | None = None,
) -> Truss:
    """Assemble a truss of layers of three nodes; a face ends each bay, and all face frames are the base's."""
    nodes = np.arange(len(home))
    faces = nodes.reshape(-1, 3)[::layers_per_bay]
    return assemble(
        module,
        tuple(f"n{i // 3}-{i % 3 + 1}" for i in range(len(home))),
        home,
        nodes // 3 - 1 if stage is None else stage,
        members,
        limits,
        stroke_factors,
        faces=faces,
        weights=weights,
        tip=faces[-1],
        tip_weights=weights,
        bays=len(faces) - 1,
        trackable=trackable,
        face_stride=face_stride,
    )
