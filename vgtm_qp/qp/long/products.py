"""A period's sparse matrices as lists of entries, by which C multiplies: see ``List`` in ``native/chain.c``."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from vgtm_qp.arrays import Array, Index
from vgtm_qp.qp.long.elimination import Elimination
from vgtm_qp.qp.long.solver import ChainSolver
from vgtm_qp.qp.long.sparse_symbols import offsets

_Matrix = tuple[Index, Index, Index]
"""Rows and columns of a matrix's entries, and their places among the numbers of a period."""


def products(solver: ChainSolver, sizes: dict[str, int]) -> dict[str, Any]:
    """Return by field the lists of a solver's chain; `sizes` says where parts of a period's numbers begin."""
    elimination, gains = solver.elimination, _gains(solver.gains)
    stages = elimination.stages
    lists: list[_Matrix] = []
    motions = offsets(stage.freedom for stage in stages)
    for k, stage in enumerate(stages):
        tied = _rows_of(elimination, stage.hard, stage.before)
        none = (np.zeros(0, dtype=np.int64),) * 3
        free = sway = lean = none
        if sizes["follows"]:
            place = _moved(gains[k], rows=stage.own[0])
        else:
            free, place, sway, lean = gains[5 * k : 5 * k + 4]
            free, place = (
                _moved(free, rows=stage.own[0], columns=motions[k]),
                _moved(place, rows=stage.own[0]),
            )
            sway, lean = _moved(sway, rows=motions[k]), _moved(lean, rows=motions[k])
        for matrix in (tied, place, free, sway, lean):
            lists += [matrix, _transposed(matrix)]
    every = list(range(elimination.size))
    strokes, (angles, centres, weights) = (
        _rows_of(elimination, elimination.actuated, every),
        _stations(solver, sizes),
    )
    curve = gains[-1] if sizes["follows"] else (np.zeros(0, dtype=np.int64),) * 3
    lists += [strokes, angles, _transposed(angles), centres, _transposed(centres), curve]
    entries = [np.stack(matrix, axis=1)[np.lexsort((matrix[1], matrix[0]))] for matrix in lists]
    hard = [row for stage in stages for row in stage.hard]
    return {
        "entries": np.concatenate(entries).astype(np.int32),
        "list_at": np.array(offsets(map(len, entries)), dtype=np.int32),
        "stage_hard": np.array(hard, dtype=np.int32),
        "stage_from": np.array(offsets(len(stage.hard) for stage in stages), dtype=np.int32),
        "centre": weights,
    }


def _moved(matrix: _Matrix, *, rows: int = 0, columns: int = 0) -> _Matrix:
    """Return a matrix with the numbers of its rows and columns raised."""
    return matrix[0] + rows, matrix[1] + columns, matrix[2]


def _transposed(matrix: _Matrix) -> _Matrix:
    return matrix[1], matrix[0], matrix[2]


def _gains(parts: list[ca.SX]) -> list[_Matrix]:
    """Return the matrices whose nonzeros, column by column, follow one another."""
    found = []
    for part, start in zip(parts, offsets(part.nnz() for part in parts)[:-1], strict=True):
        rows, columns = (np.array(places, dtype=np.int64) for places in part.sparsity().get_triplet())
        found.append((rows, columns, start + np.arange(len(rows))))
    return found


def _rows_of(elimination: Elimination, members: list[int], coordinates: list[int]) -> _Matrix:
    """Return the rows of the Jacobian of these members over these coordinates of a window."""
    entry = elimination.chain.entry[np.ix_(members, coordinates)]
    rows, columns = np.nonzero(entry >= 0)
    return rows, np.array(coordinates, dtype=np.int64)[columns], entry[rows, columns]


def _stations(solver: ChainSolver, sizes: dict[str, int]) -> tuple[_Matrix, _Matrix, Array]:
    """Return the rows of the angles (2f) and of the centres (3f) of a period's stations; the values of the latter."""
    chain = solver.chain
    angles: list[tuple[int, int, int]] = []
    centres: list[tuple[int, int, int]] = []
    for k, places in enumerate(chain.station_places.tolist()):
        for j, place in enumerate(places):
            for axis in range(3):
                centres.append((3 * k + axis, 3 * place + axis, 3 * k + j))
                angles += [
                    (2 * k + row, 3 * place + axis, sizes["faces_at"] + 9 * (2 * k + row) + 3 * j + axis)
                    for row in range(2)
                ]
    weights = np.ascontiguousarray(chain.station_weights, dtype=float).reshape(-1)
    return _matrix(angles), _matrix(centres), weights


def _matrix(entries: list[tuple[int, int, int]]) -> _Matrix:
    rows, columns, places = np.array(entries, dtype=np.int64).reshape(-1, 3).T
    return rows, columns, places
