"""Which arms are long enough, and regular enough, for a solver whose cost is linear in the bays."""

from __future__ import annotations

from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.long.chain import find_chain
from vgtm_qp.qp.long.staged import StagedSolver
from vgtm_qp.qp.long.tracked import TrackedSolver

STAGED_ACTUATORS = 46
"""From so many actuators on, elimination along the chain is faster than condensing onto the actuators."""


def chain_solver(layout: Layout) -> StagedSolver | TrackedSolver | None:
    """Return the solver along the chain of `layout`; None where it is none or its rows are not those of one."""
    if layout.general is not None or layout.hard_turns or layout.elastic_tip:
        return None
    chain = find_chain(layout)
    if chain is None:
        return None
    if layout.hard_tracking:
        return TrackedSolver(chain) if chain.is_square else None
    return StagedSolver(chain)


def prefers_staged(layout: Layout) -> bool:
    """Whether a `chain_solver` for `layout`, if there is one, is faster than the condensed QP."""
    return len(layout.arm.actuators) >= STAGED_ACTUATORS and layout.is_tabled
