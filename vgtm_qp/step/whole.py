"""The QP of a step as data: what a resolver shows of itself."""

from __future__ import annotations

import numpy as np

from vgtm_qp.qp.full import FullBuilder, StepQP
from vgtm_qp.step.arm import Arm
from vgtm_qp.step.linearise import Linearisation, Target
from vgtm_qp.step.separation import Separation
from vgtm_qp.step.state import State


def whole_qp(arm: Arm, separation: Separation, state: State, target: Target) -> StepQP:
    """Return the QP that moves the arm from `state` to `target`, in arrays of its own."""
    X, kept = state.nodes, separation.distances
    short = separation.shortfall(X, state.time)
    rows = separation.rows(X, state.time, target.time - state.time, kept.influence, short, kept.recovery)
    if target.base is not None:
        rows = rows.after(np.where(arm.task.base[:, None], target.base - X, 0.0))
    # Jacobians half a step ahead, as the step guesses it from the one before.
    linearisation = Linearisation(arm.layout, arm.kinematics, arm.task, arm.truss.home_lengths)
    numbers = linearisation.numbers(
        X,
        state.control_vertices,
        target,
        0.0,
        rows,
        motion=True,
        at=X + 0.5 * state.motion,
        torsion=state.torsion,
    )
    return FullBuilder(arm.layout).build(numbers)
