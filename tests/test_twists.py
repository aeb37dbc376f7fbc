"""Arms whose joints move nodes by twists: one compiled call against the general engine, bounds of bent motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from steps import answers, assert_same_answer, pressing

from vgtm_qp.arm.arm import Pose
from vgtm_qp.arm.build import make_arm
from vgtm_qp.bench.scenes import make_scenes
from vgtm_qp.maneuver.plan import make_plan
from vgtm_qp.methods import Resolver
from vgtm_qp.native import building
from vgtm_qp.problem import Problem
from vgtm_qp.problem.snake import snake
from vgtm_qp.qp.answer import Accuracy
from vgtm_qp.qp.fused import FusedSolver
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.qp.solvers import make_solver
from vgtm_qp.rotation import rotation_from_vector
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.engine import FusedEngine, GeneralEngine
from vgtm_qp.step.path import Path
from vgtm_qp.step.target import QPInput, Target

MANEUVER = {"steps": 10, "waypoint": [{"time": 10.0, "position": [0.1, -0.2, 1.8]}]}
MOVED = Pose(np.array([0.01, -0.02, 0.015]), rotation_from_vector([0.02, -0.01, 0.03]))


def sliding():
    """A snake with a slide in its middle and bodies of its own, one of them on the base."""
    table = snake(4)
    slide = {"name": "slide", "kind": "prismatic", "axis": [0.1, 0.2, 1.0], "position": [0.0, 0.1, 0.3]}
    table["joint"].insert(
        5, {**slide, "limits": [-0.3, 0.3], "home": 0.1, "rotation_vector": [0.1, 0.0, 0.2]}
    )
    ends = [("base", None, 0.1), ("arm", "yaw-2", 0.4), ("hand", "yaw-4", 0.5), ("sledge", "slide", 0.2)]
    table["body"] = [
        {"name": name, "points": [[0.02, 0.03, 0.0], [0.05, 0.0, end]], "radius": 0.02}
        | ({"joint": joint} if joint else {})
        for name, joint, end in ends
    ]
    return table


def locked():
    table = snake(6)
    return {**table, "locked": [{"joint": name} for name in ("pitch-1", "yaw-4", "pitch-5")]}


ARMS = {"long": snake(15), "sliding": sliding(), "locked": locked()}
TRACKED = {
    "free tip": {"method": {"tracking": "none"}},
    "elastic": {"curve": {"control_vertices": 5}, "method": {"tracking_mode": "elastic"}},
    "exact": {"curve": {"control_vertices": 5}},
    "torsion": {
        "curve": {"control_vertices": 6, "torsion_vertices": 2, "nodes": "arc-length"},
        "method": {"tracking_mode": "elastic", "weights": {"spacing": 1.0}},
        "end_effector": {"track": ["position", "pointing"]},
        "maneuver": {
            "steps": 10,
            "waypoint": [{"time": 10.0, "position": [0.1, -0.2, 1.8], "pointing": [0.0, 0.1, 1.0]}],
        },
    },
}


def setup_of(arm, **more):
    return build_arm(Problem.from_dict({"arm": ARMS[arm], "maneuver": MANEUVER} | more), solves=False)


def bent(setup, rng, size):
    """A configuration near home, the base at rest."""
    home = setup.arm.home_configuration
    moves = np.append(setup.arm.actuated, np.zeros(6, dtype=bool))
    return np.where(moves, home + size * rng.normal(size=home.shape), home)


def test_a_row_that_nothing_can_change_has_no_answer(rng):
    """DAQP leaves out rows of zeros: over nodes of the base, here."""
    setup = setup_of("sliding", **TRACKED["free tip"])
    layout, arm = setup.layout, setup.arm
    fused = FusedEngine(layout, setup.kinematics, setup.task, FusedSolver(layout, compiled=False))
    plain = GeneralEngine(layout, setup.kinematics, setup.task, make_solver("daqp", layout), compiled=False)
    assert building().finish() is not None
    assert fused.is_ready
    q, nodes = arm.home_configuration, np.flatnonzero(arm.base)[:4][None]
    here, values = arm.end_effector.position(arm.nodes(q)), q[arm.actuators]
    straight = Path(np.array([0.0, 1.0]), np.stack([here, here + 1e-3]), np.stack([np.eye(3)] * 2))
    target = Target(straight, 0.0, 1.0, values - 0.2, values + 0.2, 1.0, 1.0, None)
    for lower in (-1e-4, 1e-4):
        rows = ClearanceRows(nodes, rng.normal(size=(1, 4, 3)), np.full(1, lower), str)
        asked = QPInput(
            q, q, setup.control_vertices, setup.torsion, target, straight.at(0.0), 0.0, rows, True
        )
        both = answers((fused, plain), asked)
        assert (both is None) == (lower > 0.0)


@pytest.mark.parametrize("base", [None, MOVED])
@pytest.mark.parametrize("tracked", TRACKED)
@pytest.mark.parametrize("name", ARMS)
def test_the_compiled_call_gives_the_answer_of_the_general_engine(name, tracked, base, rng):
    setup = setup_of(name, **TRACKED[tracked])
    layout, arm = setup.layout, setup.arm
    assert building().finish() is not None
    fused = FusedEngine(layout, setup.kinematics, setup.task, FusedSolver(layout, compiled=False))
    plain = GeneralEngine(layout, setup.kinematics, setup.task, make_solver("daqp", layout), compiled=False)
    assert fused.is_ready
    q = bent(setup, rng, 0.02)
    setup.kinematics.evaluate(q)
    here, rotation = arm.end_effector.position(arm.nodes(q)), setup.kinematics.tip_rotation.copy()
    turned = rotation_from_vector([0.02, -0.01, 0.015]) @ rotation
    path = Path(np.array([0.0, 1.0]), np.stack([here, here + 0.02]), np.stack([rotation, turned]))
    values = q[arm.actuators]
    target = Target(path, 0.0, 1.0, values - 0.2, values + 0.2, 1.0, 1.0, base)
    vertices = setup.control_vertices + 0.01 * rng.normal(size=setup.control_vertices.shape)
    vertices[:2] = setup.control_vertices[:2]
    normal = rng.normal(size=(3, 4, 3))
    nodes = rng.choice(len(arm.node_names), (3, 4))
    rows = ClearanceRows(nodes, normal, np.full(3, -10.0), str)
    at = bent(setup, rng, 0.02)
    for motion, progress in ((True, 0.0), (False, 0.7)):
        goal = path.at(progress)
        asked = QPInput(q, at, vertices, setup.torsion, target, goal, progress, rows, motion)
        both = answers((fused, plain), asked._replace(rows=pressing(rows, plain.solve(asked))))
        if both is not None:
            assert_same_answer(*both, 1e-8)
            np.testing.assert_allclose(
                both[0].clearance_multipliers, both[1].clearance_multipliers, atol=1e-6
            )
    straight = Path(np.array([0.0, 1.0]), np.stack([here, here + 1e-3]), np.stack([rotation] * 2))
    asked = asked._replace(
        at=q,
        target=replace(target, path=straight),
        goal=straight.at(0.0),
        progress=0.0,
        motion=True,
        rows=ClearanceRows(),
    )
    accuracy = Accuracy(1e-10, 1e-8, 5e-3 * arm.height)
    moves = [engine.move(asked, accuracy, lambda _: None) for engine in (fused, plain)]
    np.testing.assert_allclose(moves[0].q, moves[1].q, atol=1e-8)
    assert moves[0].furthest == pytest.approx(moves[1].furthest, rel=1e-6)
    assert moves[0].progress == pytest.approx(moves[1].progress, abs=1e-7)


@pytest.mark.parametrize("name", ARMS)
def test_no_point_leaves_its_chord_further_than_the_bound(name, rng):
    arm = setup_of(name).arm
    for size, turn in ((0.02, 0.0), (0.3, 0.0), (0.1, 0.2)):
        start = arm.home_configuration + 0.2 * rng.normal(size=arm.home_configuration.shape)
        change = size * rng.normal(size=start.shape)
        change[-3:] *= turn / size
        places = np.stack([arm.nodes(start + s * change) for s in np.linspace(0.0, 1.0, 33)])
        share = np.linspace(0.0, 1.0, 33)[:, None, None]
        off = np.linalg.norm(places - (1.0 - share) * places[0] - share * places[-1], axis=2).max()
        assert 0.0 < 2.0 * off <= arm.deviation(start, start + change) + 1e-12
        # What is fixed to the tip at some distance from it turns with it.
        assert arm.tip_deviation(start, start + change, 1.0) >= 0.5 * arm.deviation(start, start + change)


def test_turns_to_and_fro_leave_chords_hardly_further_than_the_points_do(rng):
    arm = make_arm(Problem.from_dict({"arm": snake(50), "maneuver": MANEUVER}))
    start = arm.home_configuration.copy()
    change = np.append(0.01 * np.tile([1.0, 1.0, -1.0, -1.0], 25), np.zeros(6))
    places = np.stack([arm.nodes(start + s * change) for s in (0.0, 0.5, 1.0)])
    off = np.linalg.norm(places[1] - 0.5 * (places[0] + places[2]), axis=1).max()
    assert 2.0 * off <= arm.deviation(start, start + change) <= 10.0 * off


def test_the_clearance_that_is_kept_does_not_depend_on_the_duration_of_a_step():
    """Without a margin to speak of, an active clearance is kept to 1e-6 m by steps of 1 s, 0.1 s and 0.01 s."""
    scene = next(scene.problem for scene in make_scenes(("snake",)) if scene.bays == 30)
    problem = scene.replace({"clearance.margin": 1e-6, "method.slow_approach": False})
    safe, least = problem.clearance.safe, []
    for steps in (10, 100, 1000):
        resolver = Resolver(problem.replace({"maneuver.steps": steps}))
        plan, monitor, arm = (
            make_plan(problem, *resolver.tip()),
            resolver.setup.monitor,
            resolver.setup.carrier,
        )
        # So far that the clearance is active.
        end, value, found = 0.7 * plan.path.end, 0.0, []
        while value < (1.0 - 1e-9) * end:
            then = min(value + plan.path.end / steps, end)
            step = resolver.follow(plan.path, value, then)
            assert step.moved
            value += step.progress * (then - value)
            found.append(monitor.least(arm.points(resolver.state.q), among="obstacles")[0])
        least.append(min(found))
    assert all(safe - 1e-9 <= distance <= safe + 1e-6 for distance in least)
    assert max(least) - min(least) <= 1e-6
