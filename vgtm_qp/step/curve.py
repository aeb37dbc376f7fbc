"""The curve of a problem at home, as the QP needs it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Arm
from vgtm_qp.curve.curve import Curve, straight_curve
from vgtm_qp.curve.families import CurveFamily, make_family
from vgtm_qp.errors import Mistake, ProblemError
from vgtm_qp.problem import Problem
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.shape import CurveShape
from vgtm_qp.step.task import TipTask

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class HomeCurve:
    """Where a curve starts.

    Attributes
    ----------
    layout : Layout
    vertices : (V, 3)
        Control vertices at home, m.
    torsion : (T,)
        rad.
    vertex_goals : (V, 3) or None
        Where control vertices are drawn to, m; NaN for those that are not.
    """

    layout: Layout
    vertices: Array
    torsion: Array
    vertex_goals: Array | None


def home_curve(problem: Problem, arm: Arm, task: TipTask) -> HomeCurve:
    """Return the QP's layout and the curve at home; both without a curve where no station tracks one.

    Raises
    ------
    ProblemError
        Stations are to keep on the curve exactly what the arm cannot.
    """
    method, stations = problem.method, arm.stations
    if method.tracking == "none" or not len(stations) or problem.curve is None:
        empty = np.zeros((0, 0))
        layout = Layout(arm, empty, empty, np.zeros(0, dtype=np.int64), task.row_names, method.weights)
        return HomeCurve(layout, np.zeros((0, 3)), np.zeros(0), None)
    mistakes = _beyond_the_arm(problem, arm, task)
    if mistakes:
        raise ProblemError(str(problem.source or problem.name), mistakes)
    spec = problem.curve
    options = {key: getattr(spec, key) for key in ("degree", "bias", "tension") if hasattr(spec, key)}
    family = make_family(spec.family, spec.control_vertices, **options)
    stride = stations.stride if method.hard_tracking else 1
    tracked = np.arange(len(stations) - 1, stride - 1, -stride)[::-1]
    centres = stations.centres(arm.home)
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1))])
    fractions = travelled[tracked] / travelled[-1]
    s, vertices = _fitted(family, fractions, centres[0], centres[tracked])
    torsion = np.zeros(spec.torsion_vertices)
    tracks_roll = bool(torsion.size) or (method.hard_tracking and "orientation" in method.hard_coordinates)
    roll = None
    if tracks_roll:
        frames = Curve(family, vertices, torsion, stations.frames[0]).frame(s)
        turn = np.swapaxes(frames, 1, 2) @ stations.frames[tracked]
        roll = np.arctan2(turn[:, 1, 0], turn[:, 0, 0])
    by_arc_length = spec.nodes == "arc-length"
    shape = CurveShape(
        family,
        fractions if by_arc_length else s,
        by_arc_length=by_arc_length,
        torsion=torsion.size,
        roll=roll,
        tracks_roll=tracks_roll,
        spacing=_distances(centres[0], centres[tracked]) if method.weights.spacing else None,
    )
    goals = None
    if spec.control_vertex_goals:
        goals = np.full(vertices.shape, np.nan)
        for goal in spec.control_vertex_goals:
            goals[goal.index] = goal.position
    layout = Layout(
        arm,
        family.weights(s),
        family.weights(s, 1),
        tracked,
        task.row_names,
        method.weights,
        hard_tracking=method.hard_tracking,
        hard_turns=method.hard_tracking and len(method.hard_coordinates) > 1,
        shape=shape,
        vertex_goals=tuple(sorted(goal.index for goal in spec.control_vertex_goals)),
    )
    return HomeCurve(layout, vertices, torsion, goals)


def _distances(start: Array, points: Array) -> Array:
    """Return (K,) the distances from each of the points (K, 3) to the one before, `start` (3,) first."""
    return np.asarray(np.linalg.norm(np.diff(np.vstack([start, points]), axis=0), axis=1))


def _fitted(family: CurveFamily, fractions: Array, start: Array, points: Array) -> tuple[Array, Array]:
    """Return s_k (K,) and control vertices (V, 3) at home: on the straight axis, or fitted to the faces of a bent arm.

    `fractions` (K,) of the way from `start` (3,) through the `points` (K, 3) belong to these.
    """
    end = points[-1]
    straight = straight_curve(family, start, end)
    off = points - start - fractions[:, None] * (end - start)
    if np.abs(off).max() <= 1e-9 * float(np.linalg.norm(end - start)):
        # Families without linear precision run along the axis at a speed of their own.
        even = np.abs(straight.position(fractions) - points).max() <= 1e-12 * float(
            np.linalg.norm(end - start)
        )
        return fractions if even else straight.arc_parameter(fractions), straight.control_vertices
    weights = family.weights(fractions)
    second = np.diff(np.eye(family.control_vertices), n=2, axis=0)
    system = np.vstack([weights[:, 1:], 1e-3 * second[:, 1:]])
    known = np.vstack([points - np.outer(weights[:, 0], start), -1e-3 * np.outer(second[:, 0], start)])
    return fractions, np.vstack([start, np.linalg.lstsq(system, known, rcond=None)[0]])


def _beyond_the_arm(problem: Problem, arm: Arm, task: TipTask) -> list[Mistake]:
    """Return what stations are to keep on the curve although the arm has not the motions for it."""
    method, curve = problem.method, problem.curve
    if not method.hard_tracking or curve is None:
        return []
    wanted = list(method.hard_coordinates)
    if len(wanted) == 2 and curve.torsion_vertices:
        wanted.append("orientation")
    stations = arm.stations
    which = f"every {stations.word}" if stations.stride == 1 else f"every second {stations.word}"
    can = ", ".join(stations.trackable) or "nothing"
    found = []
    if not set(wanted) <= set(stations.trackable):
        missing = ", ".join(name for name in wanted if name not in stations.trackable)
        text = f"what {which} of this {arm.kind} arm can keep, {can}; it cannot keep {missing}"
        found.append(problem.mistake(("method", "hard_coordinates"), text))
    if "orientation" in wanted and task.turns == "orientation" and not curve.torsion_vertices:
        text = "1 or more: the tip is asked for roll, and faces keep the roll of the curve, which has none of its own"
        found.append(problem.mistake(("curve", "torsion_vertices"), text))
    return found
