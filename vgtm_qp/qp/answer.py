"""The answer of a step's QP, and the configuration to which it leads."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from vgtm_qp.arrays import Array


@dataclass(frozen=True)
class StepSolution:
    """The primal and dual answer of one QP, in the arm's terms.

    Attributes
    ----------
    nodes : (N, 3)
        Displacements of all nodes, base nodes included, m; (0, 3), like `vertices`, if one compiled call made
        the whole move.
    actuators : (n_a,)
        Changes of the actuated quantities, m or rad.
    vertices : (V, 3)
        Displacements of the control vertices, m.
    torsion : (T,)
        Changes of the torsion coordinates, rad.
    progress : float
        Change of the path variable alpha.
    actuator_multipliers : (n_a,)
        Positive at an upper, negative at a lower bound.
    clearance_multipliers : (R,)
        Nonnegative.
    iterations : int
        Iterations of the solver.
    tip_slack : float
        Greatest violation of the tip's rows, m or rad; zero where they are hard.
    """

    nodes: Array
    actuators: Array
    vertices: Array
    progress: float
    actuator_multipliers: Array
    clearance_multipliers: Array
    iterations: int = 0
    torsion: Array = field(default_factory=lambda: np.zeros(0))
    tip_slack: float = 0.0


@dataclass(frozen=True, eq=False)
class Closed:
    """A configuration whose fixed quantities are exact and whose actuators are in their boxes.

    Attributes
    ----------
    q : configuration
    quantities : (M,)
    error : float
        Bound of the deviations of the quantities from their target values.
    tip_position, tip_rotation : (3,), (3, 3)
    """

    q: Array
    quantities: Array
    error: float
    tip_position: Array
    tip_rotation: Array


class CurvePoint(NamedTuple):
    """A reference curve: its control vertices (V, 3), m, and torsion (T,), rad."""

    vertices: Array
    torsion: Array

    def after(self, solution: StepSolution) -> CurvePoint:
        """Return the curve after the displacements of a solution."""
        return CurvePoint(self.vertices + solution.vertices, self.torsion + solution.torsion)


class Settled(NamedTuple):
    """A closed configuration with the tip at its goal, and its curve."""

    closed: Closed
    curve: CurvePoint


class Accuracy(NamedTuple):
    """Tolerances to which quantities, the tip, and stations with hard tracking are settled, m or rad.

    These are ten times tighter than the published tolerances of ``verify``, so that rounding cannot decide
    there. A tip error above `start` after a QP calls for another QP.
    """

    member: float
    tip: float
    start: float
    tracking: float = 1e-7


class Move(NamedTuple):
    """Where the answer of one QP leads: the configuration `q` by the answer alone, the curve and the progress.

    `furthest` is the greatest displacement of a node's coordinate, m. `closed` is the configuration with quantities
    closed and the tip at its goal; None if another QP is needed.
    """

    solution: StepSolution
    q: Array
    vertices: Array
    torsion: Array
    progress: float
    furthest: float
    closed: Closed | None
