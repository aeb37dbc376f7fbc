"""The step's QP of a long arm, exactly and at a cost linear in its bays (elastic tracking or none).

A Riccati recursion from the tip to the base eliminates the free motions of every bay; the curve's coordinates
are global unknowns beside them; rows with bounds meet in a small dense QP of their own.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtrs

from vgtm_qp.errors import SolverError
from vgtm_qp.qp.long.chain import Chain
from vgtm_qp.qp.long.chain_data import ChainData
from vgtm_qp.qp.long.closing import ChainClosing
from vgtm_qp.qp.long.elimination import Elimination
from vgtm_qp.qp.long.sweep import Sweep
from vgtm_qp.qp.long.working_set import Answer, Point, RowNumbers, RowTable, solve_rows
from vgtm_qp.qp.numbers import StepNumbers, StepSolution, beyond, norm
from vgtm_qp.qp.residual import refuse_large, relative

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_BLOCK = 8
_WORST_CONDITION = 1e8
SINGULAR = "the QP is singular: the truss is in a singular pose, or a term that it needs has weight zero"


class StagedSolver:
    """Solves the QP of a step by elimination along a chain.

    Parameters
    ----------
    chain : Chain
        Of a layout without hard tracking.
    """

    knows_gain = True

    def __init__(self, chain: Chain) -> None:
        self.layout, self.chain = chain.layout, chain
        elimination = Elimination(chain)
        periods = chain.periods
        self._freedom, self._curve = periods * elimination.freedom, elimination.curve
        # The recursion runs from the tip to the base.
        self.data = ChainData(chain, elimination.inputs.sizes, reverse=True)
        self._factor = Sweep(elimination.factor(), periods)
        self._columns = Sweep(elimination.columns(_BLOCK), periods)
        self._forward = Sweep(elimination.forward(), periods)
        self._balance = Sweep(elimination.balance(), periods)
        self._strokes_sweep = Sweep(elimination.strokes(len(self.layout.tip_rows)), periods)
        self._elimination = elimination
        gains = self._factor.outputs[1]
        for k, array in enumerate((self.data.head, self.data.tail, self.data.table)):
            self._factor.bind_input(1 + k, array)
        for sweep in (self._columns, self._balance):
            sweep.bind_input(1, self.data.head)
            sweep.bind_input(2, gains)
        self._gains = gains.reshape(periods, -1)
        self._forward_head, self._forward_gains, self._motions = (
            array.reshape(periods, -1) for array in self._forward.inputs[1:]
        )
        for k, array in enumerate((self._forward_head, self._forward_gains)):
            self._strokes_sweep.bind_input(1 + k, array)
        own = chain.nodes.shape[1]
        # Rows of base nodes, which answer to no displacement, go to places behind the last one that is read.
        self._rows = np.zeros(((periods + 1) * _BLOCK * own, 3))
        self._columns.bind_input(3, self._rows.reshape(-1)[: self._columns.inputs[3].size])
        self._place = np.where(
            chain.node_period >= 0,
            (periods - 1 - chain.node_period) * _BLOCK * own + chain.node_place,
            periods * _BLOCK * own,
        )
        # A row of zeros behind those of the free nodes: base nodes do not move.
        self._moved = np.zeros((chain.nodes.size + 1, 3))
        self._forward.bind_output(1, self._moved[:-1])
        self._at = np.where(chain.node_period >= 0, chain.node_period * own + chain.node_place, -1)
        self._free, self._progress = np.zeros(self._curve), 0.0
        self._outer = self._factor.outputs[2].reshape(self._freedom, -1)
        bays = chain.bays
        at = np.empty(bays.member_count, dtype=np.int64)
        at[chain.members.reshape(-1)] = np.arange(bays.member_count)
        self._strokes, self._held, self._fixed = at[bays.actuators], at[chain.locked], at[~bays.actuated]
        soft = chain.members[:, chain.soft].reshape(-1)
        self._soft = np.argsort(soft)[np.isin(np.sort(soft), bays.actuators)]
        self._reversed_nodes = chain.nodes[::-1].reshape(-1)
        self._reversed_soft = chain.members[::-1][:, chain.soft].reshape(-1)
        self._active: set[tuple[object, ...]] = set()
        self._answer: Answer | None = None

    def solve(self, numbers: StepNumbers) -> StepSolution:
        """Solve one QP.

        Raises
        ------
        InfeasibleStepError
            The hard rows contradict one another.
        SolverError
            The QP is singular, or the answer failed the residual check.
        """
        self.data.fill(numbers)
        return self.solve_filled(RowNumbers.of(self.chain.bays, numbers))

    def solve_filled(self, numbers: RowNumbers) -> StepSolution:
        """Solve the QP whose other numbers were written to `data`; see :meth:`solve`."""
        self._eliminate(numbers)
        table = RowTable.of(self.layout, numbers, self.chain.locked)
        size = self._freedom + self._curve + 1
        self._answer = None
        answer = solve_rows(self, size, table, self._active, _BLOCK)
        self._check(table, answer.point, answer.multipliers)
        self._answer, self._active = answer, answer.active
        return answer.solution()

    def gain(self, held: NDArray[np.bool_]) -> Array | None:
        """Return the changes (n_a, n_e) of the actuated lengths that move the tip by one unit of each of its rows.

        Those of the least motion in the metric of the QP solved last; its progress and the `held` actuators (n_a,)
        stay as they are. None where they leave no such motion.
        """
        answer = self._answer
        if answer is None:
            return None
        table, known = answer.table, {row: k for k, row in enumerate(answer.rows)}
        tip = len(table.numbers.tip_rhs)
        rows = [*range(table.equal), *(table.actuators.start + np.flatnonzero(held)).tolist()]
        missing = [row for row in rows if row not in known]
        columns = answer.columns
        if missing:
            columns = np.hstack([columns, self.columns(table, np.array(missing, dtype=np.int64))])
            known |= {row: len(known) + k for k, row in enumerate(missing)}
        columns = columns[:, [known[row] for row in rows]]
        columns[-1] = 0.0
        gram = columns.T @ columns
        try:
            shares = np.linalg.solve(gram, np.eye(len(rows))[:, :tip])
        except np.linalg.LinAlgError:
            return None
        if not np.abs(shares).max(initial=0.0) * np.abs(gram).max(initial=0.0) < _WORST_CONDITION:
            return None
        combined = -columns @ shares
        motions = combined[: self._freedom]
        if self._curve:
            known_curve = combined[self._freedom : self._freedom + self._curve]
            motions = (
                motions - self._outer[:, :-1] @ dtrtrs(self._curve_factor, known_curve, lower=1, trans=1)[0]
            )
        return self._strokes_of(motions)

    def _strokes_of(self, motions: Array) -> Array:
        """Return (n_a, n_e) the changes of the actuated lengths in free motions (freedom, n_e) of the bays."""
        sweep, periods = self._strokes_sweep, self.chain.periods
        sweep.inputs[3].reshape(periods, -1)[:] = motions.reshape(periods, -1)[::-1]
        sweep()
        return sweep.outputs[1].reshape(-1, motions.shape[1]).take(self._soft, axis=0)

    def closing(self) -> ChainClosing:
        """Return what brings members to their lengths with the Jacobian of the QP solved last."""
        return ChainClosing(self.chain, self._elimination.close(), [self._forward_head, self._forward_gains])

    def columns(self, table: RowTable, rows: Index) -> Array:
        """Return (size, len(rows)) L^-1 A' of the given rows A, where H = L L'."""
        rest = slice(self._freedom, self._freedom + self._curve)
        columns = np.zeros((self._freedom + self._curve + 1, len(rows)))
        nodes, coefficients, progress = table.coefficients(rows)
        columns[-1] = progress * self._progress_scale
        passed = self._columns.outputs[1].reshape(self._freedom, _BLOCK)
        for start in range(0, len(rows), _BLOCK):
            block = slice(start, start + _BLOCK)
            count = len(progress[block])
            place = self._place[nodes[block]] + (np.arange(count) * self.chain.nodes.shape[1])[:, None]
            np.add.at(self._rows, place, coefficients[block])
            self._columns()
            columns[: self._freedom, block] = passed[:, :count]
            self._rows[place] = 0.0
        if self._curve:
            through = self._outer[:, :-1].T @ columns[: self._freedom]
            columns[rest] = -dtrtrs(self._curve_factor, through, lower=1)[0]
        return columns

    def values(self, table: RowTable, combined: Array) -> Array:
        """Return (total,) the row values where the Lagrangian is least, given columns times multipliers (size,)."""
        freedom, curve = self._freedom, self._curve
        motions = self._outer[:, -1] + combined[:freedom]
        if curve:
            known = self._curve_rhs + combined[freedom : freedom + curve]
            self._free = -dtrtrs(self._curve_factor, known, lower=1, trans=1)[0]
            motions += self._outer[:, :-1] @ self._free
        self._progress = -self._progress_scale * (self._progress_rhs + float(combined[-1]))
        self._motions[:] = motions.reshape(self.chain.periods, -1)[::-1]
        self._forward()
        changed = self._forward.outputs[2]
        return table.values(
            lambda nodes: self._moved[self._at[nodes]],
            changed.take(self._strokes),
            changed[self._held],
            self._progress,
        )

    def point(self, values: Array) -> Point:
        """Return the point whose `values` were asked for last."""
        nodes = self._moved.take(self._at, axis=0)
        return Point(nodes, self.data.vertices(self._free), self._progress, values)

    def _eliminate(self, numbers: RowNumbers) -> None:
        """Run the recursion and factorise what is left, in the curve's coordinates."""
        data = self.data
        self._factor()
        if not np.all(np.isfinite(self._outer[-1])) or not numbers.progress_curvature > 0.0:
            raise SolverError(SINGULAR)
        self._forward_head[:] = data.head[::-1]
        self._forward_gains[:] = self._gains[::-1]
        self._progress_scale = 1.0 / np.sqrt(numbers.progress_curvature)
        self._progress_rhs = self._progress_scale * numbers.progress_gradient
        if self._curve:
            hessian, gradient = data.curve_terms()
            outer = self._outer[:, :-1]
            try:
                self._curve_factor = np.linalg.cholesky(hessian - outer.T @ outer)
            except np.linalg.LinAlgError as error:
                raise SolverError(SINGULAR) from error
            gradient += self._factor.carry[-1, -self._curve :]
            self._curve_rhs = dtrtrs(self._curve_factor, gradient, lower=1)[0]

    def _check(self, table: RowTable, point: Point, multipliers: Array) -> None:
        """Refuse an answer whose primal or dual residual is too large."""
        chain, numbers, weights = self.chain, table.numbers, self.layout.weights
        bays = chain.bays
        nodal, force, face = self._balance.inputs[3:]
        gradient = weights.node_rate * point.nodes + table.nodal_forces(multipliers)
        actuator = np.zeros(bays.member_count)
        actuator[bays.actuators] = (
            (weights.actuator_rate + weights.stroke_centring) * point.values[table.actuators]
            + numbers.actuator_gradient
            + multipliers[table.actuators]
        )
        actuator[chain.locked] = multipliers[len(numbers.tip_rhs) : table.equal]
        gradient.take(self._reversed_nodes, axis=0, out=nodal.reshape(-1, 3), mode="clip")
        actuator.take(self._reversed_soft, out=force, mode="clip")
        rest = [self._balance.outputs[1]]
        if self._curve:
            parts = self._forward.outputs[3].reshape(chain.periods, -1)[::-1].reshape(-1, 5)
            gap, tilt = self.data.misfit(point.vertices, parts)
            pulled = face.reshape(-1, 5)
            pulled[:, :3], pulled[:, 3:] = weights.tracking * gap, weights.tangent * tilt
            rest.append(self.data.curve_gradient(point.vertices, gap, tilt))
        self._balance()
        outside = beyond(point.values, table.lower, table.upper)
        primal = norm(np.concatenate([outside, self._forward.outputs[2][self._fixed]]))
        refuse_large(primal, relative(norm(np.concatenate(rest)), force, multipliers), "the elimination")
