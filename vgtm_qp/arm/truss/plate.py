"""A plate of two layers for a reference surface: square cells with one apex each (paper, section 4.1)."""

from __future__ import annotations

import numpy as np

from vgtm_qp.arm.truss.assembly import MemberRow, assemble
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.problem.truss import PlateTruss


def plate(spec: PlateTruss) -> Truss:
    """Return a plate in the xz plane that grows along +z; its first two rows and the apexes between are the base.

    Nodes ``n<row>-<column>`` of the surface and ``a<row>-<column>`` over the cells' centres, towards -y. A
    free row is a stage: its surface nodes and the apexes below it. Three fixed legs ``G`` carry each apex;
    longitudinals ``L``, transverses ``T``, one diagonal ``D`` a row, and the apexes' longitudinals ``M`` and
    one transverse ``U`` are actuated. A diagonal in every cell has the right count but leaves a mechanism.

    Raises
    ------
    TrussError
        See :func:`assemble`.
    """
    rows, columns, spacing = spec.rows, spec.columns, spec.spacing
    names: list[str] = []
    positions: list[tuple[float, float, float]] = []
    stages: list[int] = []
    left = -0.5 * spacing * (columns - 1)
    for i in range(rows):
        if i:
            for j in range(columns - 1):
                names.append(f"a{i - 1}-{j + 1}")
                positions.append((left + spacing * (j + 0.5), -spec.depth, spacing * (i - 0.5)))
                stages.append(max(i - 2, -1))
        for j in range(columns):
            names.append(f"n{i}-{j + 1}")
            positions.append((left + spacing * j, 0.0, spacing * i))
            stages.append(max(i - 2, -1))
    index = {name: i for i, name in enumerate(names)}
    members = [
        MemberRow(name, (index[first], index[second]), name[0] != "G")
        for i in range(2, rows)
        for name, first, second in _row(i, columns)
    ]
    return assemble(
        spec,
        tuple(names),
        np.array(positions),
        np.array(stages, dtype=np.int64),
        members,
        (0.7, 1.4),
        faces=np.empty((0, 3), dtype=np.int64),
        weights=(1 / 3, 1 / 3, 1 / 3),
        tip=np.array([index[f"n{rows - 1}-1"], index[f"n{rows - 1}-{columns}"]]),
        tip_weights=(0.5, 0.5),
        bays=rows - 2,
        trackable=("position",),
    )


def _row(i: int, columns: int) -> list[tuple[str, str, str]]:
    """Return name and node names of the members that place row `i` and the apexes below it."""
    members: list[tuple[str, str, str]] = []
    for j in range(1, columns):
        apex = f"a{i - 1}-{j}"
        # With three columns the second apex stands on the mirror image of the first one's legs.
        mirrored = columns == 3 and j == 2
        feet = (
            (f"n{i - 1}-{j + 1}", f"n{i}-{j + 1}", f"n{i}-{j}")
            if mirrored
            else (f"n{i - 1}-{j}", f"n{i}-{j}", f"n{i}-{j + 1}")
        )
        members += [(f"G{i}-{3 * (j - 1) + k}", apex, foot) for k, foot in enumerate(feet, start=1)]
    members += [(f"L{i}-{j}", f"n{i - 1}-{j}", f"n{i}-{j}") for j in range(1, columns + 1)]
    members += [(f"T{i}-{j}", f"n{i}-{j}", f"n{i}-{j + 1}") for j in range(1, columns)]
    members += [(f"D{i}-1", f"n{i - 1}-1", f"n{i}-2")]
    members += [(f"M{i}-{j}", f"a{i - 2}-{j}", f"a{i - 1}-{j}") for j in range(1, columns)]
    members += [(f"U{i}-1", f"a{i - 1}-{columns - 2}", f"a{i - 1}-{columns - 1}")]
    return members
