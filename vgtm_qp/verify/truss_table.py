"""The arm that a problem's ``[truss]`` describes, default strokes included, to check the arm's record."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.result.chain import same

_RADIUS = 0.03
"""Default of ``member_radius``, m."""
_STROKES = {
    "octahedral": (0.6, 1.5),
    "double-octahedral": (0.6, 1.5),
    "hexapod": (0.7, 1.4),
    "longeron": (0.6, 1.4),
    "tetrahedral": (0.75, 1.3),
}
"""Default strokes of each module: least and greatest length of actuated members over their home length."""


class ExpectedMember(NamedTuple):
    """A member as in the problem, lengths in m; None for a length given by its nodes, inf without a limit."""

    actuated: bool
    length: float | None
    stroke: tuple[float, float] | None
    rate: float
    acceleration: float
    radius: float


class ExpectedTruss(NamedTuple):
    """A truss as in the problem: members by name, home positions (N, 3), m, base and tip nodes by index."""

    members: dict[str, ExpectedMember]
    home: Array
    base: tuple[int, ...]
    tip: tuple[int, ...]
    corrected: bool = False
    """Whether given lengths move the home nodes, except those of the base."""


def expected_truss(truss: Mapping[str, Any]) -> ExpectedTruss:
    """Return the truss that the table `truss` describes, JSON data that the problem's schema accepts."""
    return _of_graph(truss) if truss["module"] == "graph" else _of_module(truss)


def _of_graph(truss: Mapping[str, Any]) -> ExpectedTruss:
    index = {node["name"]: k for k, node in enumerate(truss["node"])}
    offset = 2.0 * float(truss.get("joint_offset") or 0.0)
    home = np.array([node["position"] for node in truss["node"]], dtype=np.float64)
    corrected = any(entry.get("length") is not None for entry in truss["member"])
    members = {}
    for entry in truss["member"]:
        given = {**_limits(truss), **_limits(entry)}
        length = entry.get("length")
        if length is None and not corrected and not entry.get("offsets"):
            start, end = (home[index[name]] for name in entry["nodes"])
            length = float(np.linalg.norm(end - start)) - offset
        members[entry["name"]] = _member(
            given, length, entry.get("stroke") or truss.get("stroke"), actuated=bool(entry.get("actuated"))
        )
    return ExpectedTruss(
        members,
        home,
        tuple(k for k, node in enumerate(truss["node"]) if node.get("fixed")),
        tuple(index[name] for name in truss["tip"]),
        corrected,
    )


def _of_module(truss: Mapping[str, Any]) -> ExpectedTruss:
    module, longeron, batten = truss["module"], truss.get("longeron", 1.0), truss.get("batten", 1.0)
    layers = truss["bays"] * (2 if module == "double-octahedral" else 1)
    offset = 2.0 * float(truss.get("joint_offset") or 0.0)
    lengths = {"L": longeron, "B": batten, "D": batten}
    if module == "longeron":
        lengths["D"] = math.hypot(longeron, batten)
    members = {}
    for layer in range(1, layers + 1):
        for letter, count in _counts(module).items():
            home = lengths[letter] - offset
            stroke = truss.get("stroke") or tuple(factor * home for factor in _STROKES[module])
            actuated = letter in _actuated(truss, layer)
            for k in range(1, count + 1):
                members[f"{letter}{layer}-{k}"] = _member(_limits(truss), home, stroke, actuated=actuated)
    nodes = 3 * (layers + 1)
    home = (
        _helix(nodes, longeron, batten)
        if module == "tetrahedral"
        else _layers(module, layers, longeron, batten)
    )
    return ExpectedTruss(members, home, (0, 1, 2), (nodes - 3, nodes - 2, nodes - 1))


def _counts(module: str) -> dict[str, int]:
    """Return, by letter, the numbers of members that join a layer to the one below, and its own nodes."""
    if module == "tetrahedral" or module == "longeron":
        return {"B": 3, "D": 3, "L": 3}
    return {"L": 6, "B": 3}


def _actuated(truss: Mapping[str, Any], layer: int) -> str:
    """Return the letters of the actuated members of a layer."""
    module = truss["module"]
    if module == "tetrahedral":
        return "".join("BDL"[k - 1] for k in truss.get("actuated", (1, 2, 3)))
    if module == "double-octahedral" and layer % 2 == 0:
        return ""
    return "B" if module in ("octahedral", "double-octahedral") else "L"


def _layers(module: str, layers: int, longeron: float, batten: float) -> Array:
    """Return (N, 3) stacked equilateral triangles, every second turned by 60 degrees, except in a prism."""
    height, turn = longeron, 0.0
    if module != "longeron":
        height, turn = math.sqrt(longeron**2 - batten**2 / 3.0), math.pi / 3.0
    layer, corner = np.divmod(np.arange(3 * (layers + 1)), 3)
    angle = layer % 2 * turn + corner * (2.0 * math.pi / 3.0)
    radius = batten / math.sqrt(3.0)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height * layer])


def _helix(count: int, longeron: float, batten: float) -> Array:
    """Return (N, 3) the Boerdijk-Coxeter helix about z, its second node at z = 0.

    Nodes i and i - k are 4 r^2 sin^2(k t / 2) + k^2 d^2 apart, squared: `batten` for k = 1 and 2, `longeron` for 3.
    """
    cosine = -0.5 - (longeron / batten) ** 2 / 6.0
    radius = batten * math.sqrt(0.75) / (1.0 - cosine)
    rise = math.sqrt(batten**2 - 2.0 * radius**2 * (1.0 - cosine))
    node = np.arange(count)
    angle = node * math.acos(cosine)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), (node - 1.0) * rise])


def _limits(table: Mapping[str, Any]) -> dict[str, float]:
    """Return rate, acceleration and radius in a table; those of a whole truss are for all its members."""
    keys = {"rate": "rate", "acceleration": "acceleration", "radius": "radius", "member_radius": "radius"}
    return {name: float(table[key]) for key, name in keys.items() if table.get(key) is not None}


def _member(
    given: Mapping[str, float], length: float | None, stroke: Any, *, actuated: bool
) -> ExpectedMember:
    return ExpectedMember(
        actuated,
        length,
        stroke and (float(stroke[0]), float(stroke[1])),
        given.get("rate", math.inf),
        given.get("acceleration", math.inf),
        given.get("radius", _RADIUS),
    )


def table_contradictions(arm: Any, truss: Mapping[str, Any]) -> Iterator[str]:
    """Yield where the record of a truss (``verify.arm.RecordedArm``) differs from the table `truss`."""
    if not truss:
        yield "the arm record is that of a truss; the problem has none"
        return
    expected = expected_truss(truss)
    if sorted(expected.members) != sorted(arm.member_names):
        yield "the members of the arm record are not those of the problem"
        return
    if len(expected.home) != len(arm.home) or set(arm.base.tolist()) != set(expected.base):
        yield "the nodes of the arm record, or those of its base, are not those of the problem"
        return
    if sorted(arm.tip.tolist()) != sorted(expected.tip):
        yield "the end effector of the arm record has other nodes than the problem's"
    placed = list(expected.base) if expected.corrected else slice(None)
    if not same(arm.home[placed], expected.home[placed]):
        yield "the home positions of the arm record are not those of the problem"
    stuck = {
        entry if isinstance(entry, str) else entry["member"]
        for entry in truss.get("locked") or ()
        if isinstance(entry, str) or not entry.get("time")
    }
    wanted = [expected.members[name] for name in arm.member_names]
    # In the record, a member that is stuck from the start has its home length instead of limits.
    free = [name not in stuck for name in arm.member_names]
    compared: dict[str, tuple[Any, list[Any]]] = {
        "actuated": (arm.actuated, [m.actuated if k else None for m, k in zip(wanted, free, strict=True)]),
        "length": (arm.length, [m.length for m in wanted]),
        "member_radius": (arm.radius, [m.radius for m in wanted]),
    }
    for key in ("stroke", "rate", "acceleration"):
        values = [getattr(m, key) if m.actuated and k else None for m, k in zip(wanted, free, strict=True)]
        compared[key] = (getattr(arm, key), values)
    for key, (recorded, values) in compared.items():
        differing = [
            f"{name} (problem: {value})"
            for name, found, value in zip(arm.member_names, recorded, values, strict=True)
            if value is not None and not same(found, value)
        ]
        if differing:
            more = f" and {len(differing) - 1} more members" if len(differing) > 1 else ""
            yield f"the arm record's {key} differs from the problem's at {differing[0]}{more}"
