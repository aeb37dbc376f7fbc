"""The QP of a step over the curve alone, section 4.5: the bays of a truss follow it, one by one or all at once.

With hard tracking, a bay's fixed members and the position of its end station determine its nodes, eq. (39). Nodal
displacements are then a linear function of the curve's. By the chain rule every row over nodes becomes a row over
control vertices, those of strokes and clearances included.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vgtm_qp.arrays import Array, Index
from vgtm_qp.errors import SolverError, TrussError
from vgtm_qp.qp.condensed import CondensedSolver
from vgtm_qp.qp.full import FullBuilder, StepQP
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.numbers import StepNumbers

_SINGULAR = "a bay is in a singular pose and cannot follow the curve"


class BaySolver(CondensedSolver):
    """Solves the QP of a step in the coordinates of the curve and the spare motions of the bays.

    With `parallel`, the matrices of all bays of one shape are factorised at once, and small products carry the
    displacement of each bay to the next. Otherwise bays are solved one after another; both give the same answer.

    Raises
    ------
    TrussError
        A bay has more rows than motions, for example because one of its actuators is locked.
    """

    def __init__(self, layout: Layout, *, parallel: bool) -> None:
        super().__init__(layout)
        builder = self.builder
        self._equations = _Equations(layout, builder)
        bays = _bays(layout, self._equations)
        shapes: dict[tuple[int, int, int], list[Bay]] = {}
        for bay in bays:
            shapes.setdefault((len(bay.rows), len(bay.own), len(bay.before)), []).append(bay)
        together = list(shapes.values()) if parallel else [[bay] for bay in bays]
        self._groups = [_Group(alike, self._equations) for alike in together]
        spare = bays[-1].spare.stop
        self._free = slice(spare, spare + layout.free_curve)
        self._unknown = np.concatenate([np.full(self._free.stop, -1), self._after])
        # Bays follow the curve in positions, or in positions and turns; the last station's turn is left to
        # the QP.
        followed = 3 * len(layout.tracked) + layout.turns * len(layout.tracked) * layout.hard_turns
        left = builder.hard_gaps[builder.hard_gaps >= builder.gaps[0] + followed]
        self._actuators, self._equal = self._before, len(left)
        self._bounded = np.concatenate([left, self._actuators])
        self._actuated_rows = np.flatnonzero(layout.arm.actuated)

    def _reduction(self, numbers: StepNumbers, qp: StepQP) -> tuple[Array, Array]:
        """Return Z (n, size) and z_0 (n,) of the unknowns of the full QP."""
        builder, size = self.builder, len(self._unknown)
        # The last column is the constant part.
        whole = np.zeros((builder.size, size + 1))
        whole[self._after, np.arange(self._free.stop, size)] = 1.0
        curve, whole[curve, self._free], whole[curve, -1] = self._on_base(numbers)
        missing = -(qp.A @ whole)
        missing[:, -1] += qp.row_lower
        values = self._equations.values(numbers)
        try:
            passed = [after for group in self._groups for after in group.solved(values, missing)]
        except np.linalg.LinAlgError:
            raise SolverError(_SINGULAR) from None
        for after in sorted(passed, key=lambda after: after.bay.number):
            bay = after.bay
            whole[bay.own] = after.known - after.gain @ whole[bay.before]
            whole[bay.own, bay.spare] += after.free
        if not np.isfinite(whole).all():
            raise SolverError(_SINGULAR)
        follows = qp.A @ whole
        follows[:, -1] -= qp.row_lower
        whole[self._actuators] = follows[self._actuated_rows]
        whole[builder.gaps] = follows[builder.gap_rows]
        return whole[:, :-1], whole[:, -1]


class Bay(NamedTuple):
    """The nodes between two tracked stations.

    ``rows`` are its equations in the full QP, ``own`` the columns of its nodes, and ``before`` the columns of nodes
    placed earlier that the equations depend on. With more columns than equations the bay has spare motions, which
    are the unknowns ``spare`` of the QP.
    """

    number: int
    rows: Index
    own: Index
    before: Index
    spare: slice


class _BayMotion(NamedTuple):
    """The displacements of a bay's own columns: ``known`` (c, size + 1) - ``gain`` (c, b) times those before.

    ``free`` (c, c - r) are the displacements by its spare motions.
    """

    bay: Bay
    known: Array
    gain: Array
    free: Array


class _Equations:
    """The rows by which bays follow the curve: lengths of fixed members, and stations kept on the curve.

    ``rows`` and ``columns`` are the places of their entries (E,) over nodes in the full QP.
    """

    def __init__(self, layout: Layout, builder: FullBuilder) -> None:
        arm, stations, turns = layout.arm, layout.arm.stations, layout.turns
        pattern = arm.motion_pattern
        self._kept = np.flatnonzero(~arm.actuated[pattern.rows] & (pattern.columns < layout.node_columns))
        columns = layout.node_column[stations.nodes[layout.tracked]]
        k, slot = np.nonzero(columns >= 0)
        axis, turn = np.arange(3), np.arange(turns)
        own = columns[k, slot][:, None] + axis
        rows = [pattern.rows[self._kept], (builder.gap_rows[0] + 3 * k[:, None] + axis).ravel()]
        places = [pattern.columns[self._kept], own.ravel()]
        self._weights = np.repeat(stations.weights[layout.tracked][k, slot], 3)
        self._turned: tuple[Index, ...] | None = None
        if layout.hard_turns:
            first = builder.gap_rows[0] + 3 * len(layout.tracked)
            shape = len(k), turns, 3
            rows.append(np.broadcast_to(first + turns * k[:, None, None] + turn[:, None], shape).ravel())
            places.append(np.broadcast_to(own[:, None], shape).ravel())
            self._turned = k, slot
        self.rows, self.columns = np.concatenate(rows), np.concatenate(places)

    def values(self, numbers: StepNumbers) -> Array:
        """Return the entries (E,)."""
        parts = [numbers.motion.values[self._kept], self._weights]
        if self._turned is not None:
            k, slot = self._turned
            face = numbers.tangent_face
            parts.append(face.reshape(*face.shape[:2], 3, 3)[k, :, slot].ravel())
        return np.concatenate(parts)


class _Group:
    """Bays of one shape, whose matrices are factorised at once."""

    def __init__(self, bays: list[Bay], equations: _Equations) -> None:
        self._bays, one = bays, bays[0]
        self._rows = np.stack([bay.rows for bay in bays])
        self._own, width = len(one.own), len(one.own) + len(one.before)
        self._shape = len(bays), len(one.rows), width
        row_place = {int(row): (b, i) for b, bay in enumerate(bays) for i, row in enumerate(bay.rows)}
        column_place = [{int(column): j for j, column in enumerate([*bay.own, *bay.before])} for bay in bays]
        kept, places = [], []
        for entry, (row, column) in enumerate(
            zip(equations.rows.tolist(), equations.columns.tolist(), strict=True)
        ):
            if row in row_place:
                b, i = row_place[row]
                kept.append(entry)
                places.append((b * self._shape[1] + i) * width + column_place[b][column])
        self._kept, self._places = np.array(kept), np.array(places)

    def solved(self, values: Array, missing: Array) -> list[_BayMotion]:
        """Return each bay's displacements over curve and earlier bays, for right-hand sides `missing`."""
        size = int(np.prod(self._shape))
        flat = np.bincount(self._places, weights=values[self._kept], minlength=size)
        own, before = np.split(flat.reshape(self._shape), [self._own], axis=2)
        right = np.concatenate([missing[self._rows], before], axis=2)
        equations = self._shape[1]
        if equations == self._own:
            answer, free = np.linalg.solve(own, right), np.zeros((len(own), self._own, 0))
        else:
            Q, R = np.linalg.qr(np.swapaxes(own, 1, 2), mode="complete")
            lower = np.swapaxes(R[:, :equations], 1, 2)
            answer, free = Q[:, :, :equations] @ np.linalg.solve(lower, right), Q[:, :, equations:]
        columns = missing.shape[1]
        return [
            _BayMotion(bay, answer[b, :, :columns], answer[b, :, columns:], free[b])
            for b, bay in enumerate(self._bays)
        ]


def _bays(layout: Layout, equations: _Equations) -> list[Bay]:
    """Return the bays between tracked stations; each row belongs to the last bay that it has a column of."""
    arm, count = layout.arm, len(layout.tracked)
    assert arm.bays is not None
    stage = arm.bays.stage
    ends = np.maximum.accumulate([stage[nodes].max() for nodes in arm.stations.nodes[layout.tracked]])
    ends[-1] = stage.max()
    number = np.repeat(np.searchsorted(ends, stage[arm.free]), 3)
    columns = np.argsort(number, kind="stable")
    last = np.full(int(equations.rows.max()) + 1, -1)
    np.maximum.at(last, equations.rows, number[equations.columns])
    bays: list[Bay] = []
    spare = 0
    for k in range(count):
        rows, own = np.flatnonzero(last == k), columns[number[columns] == k]
        touched = np.unique(equations.columns[np.isin(equations.rows, rows)])
        more = len(own) - len(rows)
        if more < 0:
            where = f"{arm.stations.word} {layout.tracked[k]}"
            raise TrussError(
                f"the bays up to {where} have {-more} motions too few to stay on the curve: tracking by bays takes "
                "actuators that are not locked from the start"
            )
        bays.append(Bay(k, rows, own, np.setdiff1d(touched, own), slice(spare, spare + more)))
        spare += more
    return bays
