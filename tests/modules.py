"""Trusses as a problem file would give them, and any truss from plain tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from vgtm_qp.arm.truss.build import build_truss
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.problem.truss import GraphTruss, ModuleTruss, TetrahedralTruss


def octahedral(bays: int, **keys: Any) -> Truss:
    return build_truss(ModuleTruss(module="octahedral", bays=bays, **keys))


def double_octahedral(bays: int, **keys: Any) -> Truss:
    return build_truss(ModuleTruss(module="double-octahedral", bays=bays, **keys))


def hexapod(bays: int, **keys: Any) -> Truss:
    return build_truss(ModuleTruss(module="hexapod", bays=bays, **keys))


def longeron(bays: int, **keys: Any) -> Truss:
    return build_truss(ModuleTruss(module="longeron", bays=bays, **keys))


def tetrahedral(bays: int, **keys: Any) -> Truss:
    return build_truss(TetrahedralTruss(module="tetrahedral", bays=bays, **keys))


def graph_truss(
    nodes: Sequence[Mapping[str, Any]],
    members: Sequence[Mapping[str, Any]],
    tip: Iterable[str],
    faces: Iterable[Iterable[str]] = (),
    **more: Any,
) -> Truss:
    """The truss of plain tables, the same as those of a problem file; other keys of ``[truss]`` by keyword."""
    tables = {"node": tuple(nodes), "member": tuple(members), "tip": tuple(tip)}
    spec = {"module": "graph", **tables, "faces": tuple(tuple(face) for face in faces), **more}
    return build_truss(GraphTruss.model_validate(spec))
