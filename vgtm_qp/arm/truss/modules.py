"""The periodic trusses of the paper: each builder stacks one module along +z of the base frame.

A name is a kind, a layer of nodes (0 is the base) and a place in it (from 1): node ``n0-1``, batten ``B4-1``,
longeron or leg ``L3-2``, diagonal ``D2-1``. Lengths of a table are distances between nodes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from vgtm_qp.arm.truss.assembly import MemberRow, assemble
from vgtm_qp.arm.truss.truss import Array, Index, Truss
from vgtm_qp.problem.truss import ModuleTruss, TetrahedralTruss

_POSE = ("position", "pointing", "orientation")


class _Module(NamedTuple):
    """What tells the modules of triangular layers apart.

    Attributes
    ----------
    longerons : bool
        Whether the members between two layers are actuated (but for diagonals).
    battens : tuple of bool
        Whether the battens of each layer of a bay are.
    stroke : (2,)
        Least and greatest length of an actuated member over its home length, where a table has none.
    trackable, face_stride
        See ``Truss``.
    """

    longerons: bool
    battens: tuple[bool, ...]
    stroke: tuple[float, float]
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
        See :func:`assemble`.
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
    return _layered(
        spec,
        home,
        members,
        module.stroke,
        layers_per_bay=per_bay,
        trackable=module.trackable,
        face_stride=module.face_stride,
    )


def tetrahedral(spec: TetrahedralTruss) -> Truss:
    """Return tetrahedra face on face (Boerdijk-Coxeter helix): each node hangs by three members on the three before.

    A bay is three nodes, and every node is a stage of its own. Members (i, i-1) and (i, i-2) are the battens
    ``B`` and ``D``, members (i, i-3) the longerons ``L``. The home pose is a helix about z, theta its turn a
    node, cos theta = -1/2 - L^2 / (6 b^2). Three successive nodes with the weights w, 1 - 2 w, w, where
    w = 1 / (2 (1 - cos theta)), have their mean on its axis (w = 0.3 where L = b). No face is normal to the
    axis, the base neither: its axis point is the origin.

    Raises
    ------
    TrussError
        See :func:`assemble`.
    """
    home, cosine = _helix(3 * (spec.bays + 1), spec.longeron, spec.batten)
    members = [
        MemberRow(f"{kind}{i // 3}-{i % 3 + 1}", (i - k, i), k in spec.actuated)
        for i in range(3, len(home))
        for k, kind in ((1, "B"), (2, "D"), (3, "L"))
    ]
    weight = 1.0 / (2.0 * (1.0 - cosine))
    return _layered(
        spec,
        home,
        members,
        (0.75, 1.3),
        trackable=_POSE if len(spec.actuated) > 1 else ("position",),
        weights=(weight, 1.0 - 2.0 * weight, weight),
        stage=np.maximum(np.arange(len(home)) - 3, -1),
    )


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


def _layered(
    spec: ModuleTruss | TetrahedralTruss,
    home: Array,
    members: Sequence[MemberRow],
    stroke_factors: tuple[float, float],
    *,
    trackable: tuple[str, ...],
    layers_per_bay: int = 1,
    face_stride: int = 1,
    weights: Sequence[float] = (1 / 3, 1 / 3, 1 / 3),
    stage: Index | None = None,
) -> Truss:
    """Assemble a truss of layers of three nodes; a face ends each bay."""
    nodes = np.arange(len(home))
    faces = nodes.reshape(-1, 3)[::layers_per_bay]
    return assemble(
        spec,
        tuple(f"n{i // 3}-{i % 3 + 1}" for i in range(len(home))),
        home,
        nodes // 3 - 1 if stage is None else stage,
        members,
        stroke_factors,
        faces=faces,
        weights=weights,
        tip=faces[-1],
        tip_weights=weights,
        bays=spec.bays,
        trackable=trackable,
        face_stride=face_stride,
    )
