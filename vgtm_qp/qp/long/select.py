"""Which arms are long enough, and regular enough, for a solver whose cost is linear in the bays."""

from __future__ import annotations

from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.long.chain import Chain, find_chain
from vgtm_qp.qp.long.staged import StagedSolver
from vgtm_qp.qp.long.tracked import TrackedSolver

STAGED_ACTUATORS = 46
"""From so many actuators on, elimination along the chain is faster than condensing onto the actuators."""


def chain_solver(layout: Layout) -> StagedSolver | TrackedSolver | None:
    """Return the solver along the chain of `layout`; None where it is none or its rows are not those of one."""
    chain = _chain(layout)
    if chain is None:
        return None
    if not layout.hard_tracking:
        return StagedSolver(chain)
    return TrackedSolver(chain) if chain.is_square else None


def prefers_staged(layout: Layout) -> bool:
    """Whether `chain_solver` is there for `layout` and faster than the condensed QP."""
    if len(layout.arm.actuators) < STAGED_ACTUATORS or not layout.is_tabled:
        return False
    chain = _chain(layout)
    return chain is not None and (not layout.hard_tracking or chain.is_square)


def _chain(layout: Layout) -> Chain | None:
    """Return the chain where the QP has only rows that the eliminations know: a curve of tables, a hard tip."""
    if layout.general is not None or layout.hard_turns or layout.elastic_tip:
        return None
    return find_chain(layout)
