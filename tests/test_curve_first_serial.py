"""The curve first, then segments of joints: on serial arms, against the recorded chain by other code."""

from __future__ import annotations

import re
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

import vgtm_qp as vq
from vgtm_qp.maneuver.plan import make_plan
from vgtm_qp.methods import PRESETS, CurveFirstResolver, with_method
from vgtm_qp.problem import Problem
from vgtm_qp.problem.snake import snake
from vgtm_qp.result.chain import RecordedChain

WAYS = ("recursive", "parallel")
ARMS = ("snake_past_a_cube", "twelve_joints_past_a_crate", "station_arm_past_a_module", "sliding")


def sliding() -> Problem:
    """Return a small arm of joints that turn, slide and follow, whose tool is turned against its last link."""
    z, x, y = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
    axes = [("roll", z), ("pitch", x), ("boom", z), ("yaw", y), ("bend", x), ("twin", y), ("reach", z)]
    axes += [("nod", x), ("turn", y), ("spin", z), ("last", x)]
    homes = [0.1, 0.2, 0.2, 0.1, 0.2, 0.2, 0.1, 0.2, 0.1, 0.1, 0.2]
    joints: list[dict[str, Any]] = [
        {"name": name, "axis": axis, "home": home, "position": [0.0, 0.02, 0.4]}
        for (name, axis), home in zip(axes, homes, strict=True)
    ]
    for k in (2, 6):
        joints[k] |= {"kind": "prismatic", "limits": [-0.5, 0.8]}
    joints[5]["mimic"] = {"joint": "yaw", "multiplier": 0.5, "offset": 0.15}
    table = {
        "arm": {"joint": joints, "tip": [0.0, 0.0, 0.3], "link_radius": 0.02, "every": 4},
        "curve": {"control_vertices": 6},
        "maneuver": {"steps": 20, "waypoint": [{"time": 5.0, "position": [0.0, 0.0, 1.0]}]},
    }
    return Problem.from_dict(table)


def problem_of(name: str, *, steps: int = 20, way: float = 0.06, **method: Any) -> Problem:
    """Return a maneuver that moves the tip sideways and down by a part of the arm's length, among no obstacles."""
    problem = sliding() if name == "sliding" else vq.load_problem(name)
    problem = problem.replace({"method": {"name": "curve-pseudoinverse", **method}, "obstacle": []})
    resolver = CurveFirstResolver(problem)
    (tip, rotation), length = resolver.tip(), resolver.setup.arm.height
    goal = {"time": 5.0, "position": (tip + way * length * np.array([0.6, 0.5, -1.0])).tolist()}
    if "pointing" in problem.end_effector.track:
        goal["pointing"] = (rotation[:, 2] + [0.2, 0.1, 0.0]).tolist()
    return problem.replace({"maneuver": {"steps": steps, "waypoint": [goal]}})


def followed(resolver: CurveFirstResolver, problem: Problem) -> np.ndarray:
    """Move along the problem's path; return the quantities after each step."""
    plan = make_plan(problem, *resolver.tip())
    found = []
    for start, end in pairwise([plan.path.start, *plan.marks.tolist()]):
        step = resolver.follow(plan.path, start, end)
        assert not step.reason, step.reason
        found.append(np.array(resolver.state.quantities))
    return np.stack(found)


def stations(resolver: CurveFirstResolver) -> list[int]:
    return [segment.station for segment in resolver.tracker.segments]


class Recorded:
    """The segments' end stations by the certificate's code, as functions of the quantities."""

    def __init__(self, resolver: CurveFirstResolver) -> None:
        self.arm, self.segments = resolver.setup.arm, resolver.tracker.segments
        self._chain = RecordedChain(self.arm.record())
        self._nodes = self.arm.stations.nodes[stations(resolver)][:, 0]

    def configuration(self, quantities: np.ndarray) -> np.ndarray:
        """(T, J + 6) configurations with the base at home."""
        joints = self._chain.joints(np.atleast_2d(quantities))
        return np.concatenate([joints, np.zeros((len(joints), 6))], axis=1)

    def positions(self, quantities: np.ndarray) -> np.ndarray:
        """(T, S, 3) positions, m."""
        return self._chain.placed(self.configuration(quantities))[0][:, self._nodes]

    def rotation(self, quantities: np.ndarray) -> np.ndarray:
        """(3, 3) of the end effector."""
        return self._chain.tip_rotations(self.configuration(quantities))[0]

    def rows(self, quantities: np.ndarray, h: float = 1e-6) -> list[np.ndarray]:
        """Jacobian (r, n_a) of each segment's end by the actuators, angles times the arm's unit, by differences."""
        arm, by_joint = self.arm, []
        for k in range(len(arm.actuators)):
            change = np.zeros(len(quantities))
            change[arm.actuators[k]] = h / arm.levers[k]
            there, back = quantities + change, quantities - change
            moved = (self.positions(there) - self.positions(back))[0]
            turned = (self.rotation(there) - self.rotation(back)) @ self.rotation(quantities).T
            by_joint.append((moved, np.array([turned[2, 1], turned[0, 2], turned[1, 0]])))
        moved, turned = (np.stack([one[i] for one in by_joint], axis=-1) / (2.0 * h) for i in (0, 1))
        rows = list(moved)
        if self.segments[-1].tracks == "pointing":
            turned = self.rotation(quantities)[:, :2].T @ turned
        if self.segments[-1].tracks != "position":
            rows[-1] = np.concatenate([rows[-1], turned])
        return rows


@pytest.mark.parametrize("correct", [False, True])
@pytest.mark.parametrize("name", ARMS)
def test_parallel_tracking_is_recursive_tracking(name: str, correct: bool) -> None:
    ways = []
    for tracking in WAYS:
        problem = problem_of(name, tracking=tracking, correct=correct)
        ways.append(followed(CurveFirstResolver(problem), problem))
    assert np.ptp(ways[0], axis=0).max() > 0.05
    np.testing.assert_allclose(*ways, atol=1e-8)


@pytest.mark.parametrize("name", ARMS)
def test_stations_meet_their_curve_nodes_and_the_tip_its_goal(name: str) -> None:
    problem = problem_of(name, correct=True)
    resolver = CurveFirstResolver(problem)
    followed(resolver, problem)
    recorded, state = Recorded(resolver), resolver.state
    nodes = resolver.curve.position(resolver.motion.s[stations(resolver)])
    np.testing.assert_allclose(recorded.positions(state.quantities)[0], nodes, atol=1e-10)
    goal = problem.maneuver.waypoint[0]
    np.testing.assert_allclose(resolver.tip()[0], goal.position, atol=1e-9)
    if goal.pointing is not None:
        direction = np.array(goal.pointing) / np.linalg.norm(goal.pointing)
        np.testing.assert_allclose(recorded.rotation(state.quantities)[:, 2], direction, atol=1e-9)
    # Followers keep to their joints, and the base is at rest.
    followers = [one.joint for one in resolver.setup.arm.followers]
    home = resolver.setup.arm.home_quantities
    np.testing.assert_allclose(state.quantities[followers], home[followers], atol=1e-15)
    np.testing.assert_array_equal(state.q[-6:], 0.0)


@pytest.mark.parametrize("tracking", WAYS)
@pytest.mark.parametrize("name", ARMS)
def test_uncorrected_rates_are_pseudoinverses_of_differences(name: str, tracking: str) -> None:
    problem = problem_of(name, tracking=tracking)
    resolver = CurveFirstResolver(problem)
    plan = make_plan(problem, *resolver.tip())
    assert not resolver.follow(plan.path, 0.0, float(plan.marks[1])).reason
    recorded, before, curve = Recorded(resolver), resolver.state, resolver.curve
    assert not resolver.follow(plan.path, float(plan.marks[1]), float(plan.marks[2])).reason
    s, arm = resolver.motion.s[stations(resolver)], resolver.setup.arm
    moved = resolver.curve.position(s) - curve.position(s)
    turn = resolver.curve.frame(1.0) @ curve.frame(1.0).T
    # The sine of the turn is the angle, to third order.
    vector = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2.0
    expected = np.zeros(len(arm.actuators))
    for segment, rows, x in zip(recorded.segments, recorded.rows(before.quantities), moved, strict=True):
        if segment.tracks == "pointing":
            x = np.concatenate([x, recorded.rotation(before.quantities)[:, :2].T @ vector])
        own = slice(segment.start, segment.end)
        missing = x - rows[:, : segment.start] @ expected[: segment.start]
        expected[own] = np.linalg.pinv(rows[:, own]) @ missing
    found = (resolver.state.quantities - before.quantities)[arm.actuators] * arm.levers
    assert np.abs(found).max() > 1e-3
    np.testing.assert_allclose(found, expected, atol=2e-6)


@pytest.mark.parametrize("name", ARMS)
def test_each_segment_has_the_answer_of_scipys_least_squares(name: str) -> None:
    """One step: a segment's joints in the row space of its matrix at the start, those before it where they ended."""
    problem = problem_of(name, correct=True)
    resolver = CurveFirstResolver(problem)
    recorded, before = Recorded(resolver), np.array(resolver.state.quantities)
    plan = make_plan(problem, *resolver.tip())
    assert not resolver.follow(plan.path, 0.0, float(plan.marks[0])).reason
    after, arm = resolver.state.quantities, resolver.setup.arm
    nodes, tangent = (
        resolver.curve.position(resolver.motion.s[stations(resolver)]),
        resolver.curve.tangent(1.0),
    )
    for segment, rows in zip(recorded.segments, recorded.rows(before), strict=True):
        own = arm.actuators[segment.start : segment.end]
        space = np.linalg.qr(rows[:, segment.start : segment.end].T)[0]

        def moved(x: np.ndarray, own=own, space=space, segment=segment) -> np.ndarray:
            values = np.array(after)
            values[own] = before[own] + space @ x / arm.levers[segment.start : segment.end]
            return values

        def missing(x: np.ndarray, moved=moved, segment=segment) -> np.ndarray:
            values = moved(x)
            gap = recorded.positions(values)[0, segment.number] - nodes[segment.number]
            turn = recorded.rotation(values)[:, 2] - tangent
            return gap if segment.tracks == "position" else np.concatenate([gap, turn])

        found = least_squares(missing, np.zeros(space.shape[1]), xtol=1e-15, ftol=1e-15, gtol=1e-15)
        np.testing.assert_allclose(missing(found.x), 0.0, atol=1e-10)
        np.testing.assert_allclose(moved(found.x)[own], after[own], atol=1e-7)


def test_orientation_turns_the_tool_by_the_last_joints_together() -> None:
    data = vq.load_problem("twelve_joints_past_a_crate").to_dict() | {"obstacle": []}
    data["end_effector"] = {"track": ["position", "orientation"]}
    data["arm"]["tip_rotation_vector"] = [0.1, 0.2, 0.3]
    data["curve"] |= {"control_vertices": 6, "torsion_vertices": 2}
    data["method"] = {"name": "curve-pseudoinverse", "correct": True}
    data["maneuver"] = {
        "steps": 10,
        "waypoint": [{"time": 4.0, "position": [0.0] * 3, "rotation_vector": [0.0] * 3}],
    }
    resolver = CurveFirstResolver(Problem.from_dict(data))
    tip, rotation = resolver.tip()
    turned = np.array([[0.995, -0.0998, 0.0], [0.0998, 0.995, 0.0], [0.0, 0.0, 1.0]])
    waypoint = data["maneuver"]["waypoint"][0]
    waypoint |= {"position": np.add(tip, [0.06, 0.05, -0.05]).tolist()}
    waypoint |= {"rotation_vector": vq.rotation.vector_from_rotation(rotation @ turned).tolist()}
    ways = []
    for tracking in WAYS:
        data["method"]["tracking"] = tracking
        problem = Problem.from_dict(data)
        resolver = CurveFirstResolver(problem)
        assert [(one.tracks, one.start) for one in resolver.tracker.segments][-1] == ("orientation", 4)
        ways.append(followed(resolver, problem))
        expected = make_plan(problem, *resolver.tip()).path.at(1e9).rotation
        np.testing.assert_allclose(
            Recorded(resolver).rotation(resolver.state.quantities), expected, atol=1e-8
        )
        np.testing.assert_allclose(resolver.tip()[0], waypoint["position"], atol=1e-9)
    np.testing.assert_allclose(*ways, atol=1e-8)


def segments(**arm: Any) -> list[tuple[int, int, int]]:
    table = {**snake(8), "every": 4} | arm
    goal = {"time": 1.0, "position": [0.5, 0.0, 3.0]}
    problem = {"arm": table, "curve": {"control_vertices": 6}, "maneuver": {"steps": 5, "waypoint": [goal]}}
    resolver = CurveFirstResolver(Problem.from_dict(problem | {"method": {"name": "curve-pseudoinverse"}}))
    return [(one.station, one.start, one.columns) for one in resolver.tracker.segments]


def with_mimic(joint: int, followed: int) -> list[dict[str, Any]]:
    rows = snake(8)["joint"]
    rows[joint]["mimic"] = {"joint": rows[followed]["name"]}
    return rows


def test_segments_are_joined_until_their_joints_can_do_their_part() -> None:
    assert segments() == [(1, 0, 4), (2, 4, 4), (3, 8, 4), (4, 12, 4)]
    # Of three joints two bend at one place, and of these one moves no station there: two bends place no point.
    assert segments(every=3) == [(2, 0, 6), (4, 6, 6), (6, 12, 4)]
    # Locked joints leave the first segment two motions.
    assert segments(locked=["pitch-1", "yaw-2"]) == [(2, 0, 6), (3, 6, 4), (4, 10, 4)]
    # A follower moves with a joint of an earlier segment, which is given.
    assert segments(joint=with_mimic(9, 1)) == [(1, 0, 4), (2, 4, 4), (3, 8, 3), (4, 11, 4)]
    # It follows a joint of the third segment: no station between them ends one.
    assert segments(joint=with_mimic(1, 9)) == [(3, 0, 11), (4, 11, 4)]


@pytest.mark.parametrize("joints", [(9, 1), (1, 9)])
@pytest.mark.parametrize("tracking", WAYS)
def test_followers_and_locked_joints_keep_to_their_rules(joints: tuple[int, int], tracking: str) -> None:
    locked = [snake(8)["joint"][4]["name"]]
    data = {
        "arm": {**snake(8), "every": 4, "joint": with_mimic(*joints), "locked": locked},
        "curve": {"control_vertices": 6},
        "maneuver": {"steps": 10, "waypoint": [{"time": 5.0, "position": [0.0, 0.0, 1.0]}]},
        "method": {"name": "curve-pseudoinverse", "tracking": tracking, "correct": True},
    }
    resolver = CurveFirstResolver(Problem.from_dict(data))
    data["maneuver"]["waypoint"][0]["position"] = (resolver.tip()[0] + [0.15, 0.1, -0.15]).tolist()
    problem = Problem.from_dict(data)
    resolver = CurveFirstResolver(problem)
    home = resolver.state.q
    followed(resolver, problem)
    values = resolver.state.q
    assert values[4] == home[4]
    assert values[joints[0]] == pytest.approx(values[joints[1]], abs=1e-14)
    assert abs(values[joints[1]] - home[joints[1]]) > 1e-3
    np.testing.assert_allclose(resolver.tip()[0], data["maneuver"]["waypoint"][0]["position"], atol=1e-9)


def test_the_potential_keeps_a_snake_further_from_the_cube() -> None:
    problem, nearest = vq.load_problem("snake_past_a_cube"), []
    for name in ("curve-pseudoinverse-corrected", "curve-pseudoinverse-obstacles"):
        resolver = CurveFirstResolver(with_method(problem, name))
        plan = make_plan(problem, *resolver.tip())
        for start, end in pairwise([plan.path.start, *plan.marks[:34].tolist()]):
            assert not resolver.follow(plan.path, start, end).reason
        nearest.append(resolver.setup.least_clearance(resolver.state.q, 0.0, "obstacles"))
    assert nearest[1] > nearest[0] + 0.01


@pytest.mark.parametrize("name", [name for name in PRESETS if name.startswith("curve")])
def test_every_preset_moves_a_snake_along_its_path(name: str) -> None:
    problem = with_method(vq.load_problem("snake_past_a_cube"), name).replace({"obstacle": []})
    goal = {"time": 10.0, "position": [1.9, -0.3, 3.0]}
    maneuver = vq.solve(problem.replace({"maneuver.waypoint": [goal], "maneuver.steps": 40}))
    assert maneuver.arrived, maneuver.blocked_by
    off = np.linalg.norm(maneuver.tip_position - maneuver.tip_target_position, axis=1).max()
    assert off < (1e-9 if problem.method.correct else 0.1)
    certificate = maneuver.certificate
    assert certificate is not None
    assert not certificate.contradictions
    assert certificate.tracking_gap.value is not None
    assert certificate.tracking_gap.value < (1e-10 if problem.method.correct else 0.1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"arm": snake(8, bend=0.0)}, r'method\.name: .*cannot move the 3 tracked coordinates.*expected "qp", or an'),
        ({"arm.locked": [{"joint": "yaw-2", "time": 1.0}]}, r"arm\.locked: .*expected no actuator that jams"),
        ({"arm.base_motion": [{"time": 1.0, "position": [0.1, 0.0, 0.0]}]}, r"arm\.base_motion: .*a base at rest"),
        ({"curve.control_vertices": 3, "end_effector.track": ["position", "pointing"],
          "maneuver.waypoint": [{"time": 1.0, "position": [0.5, 0.0, 3.0], "pointing": [0, 0, 1]}]},
         r"curve\.control_vertices: found 3; expected 4 or more: base and tip fix 10 coordinates"),
        ({"curve.nodes": "arc-length"}, r'curve\.nodes: found "arc-length"; expected "parameter"'),
    ],
)  # fmt: skip
def test_what_the_method_cannot_do_is_named_by_its_key(changes: dict[str, Any], message: str) -> None:
    data = {
        "arm": snake(8),
        "curve": {"control_vertices": 6},
        "maneuver": {"steps": 5, "waypoint": [{"time": 1.0, "position": [0.5, 0.0, 3.0]}]},
        "method": {"name": "curve-pseudoinverse"},
    }
    with pytest.raises(vq.ProblemError, match=message):
        vq.Resolver(Problem.from_dict(data).replace(changes))


def test_an_actuator_cannot_be_locked_on_the_way() -> None:
    resolver = CurveFirstResolver(problem_of("snake_past_a_cube"))
    with pytest.raises(vq.GoalError, match='methods that can: "qp", "pseudoinverse"'):
        resolver.lock("yaw-3")
    assert not resolver.locked


def test_a_curve_node_out_of_reach_stops_the_arm_with_its_joints_named() -> None:
    problem = problem_of("snake_past_a_cube", correct=True, null_space=[])
    maneuver = vq.solve(problem.replace({"maneuver.waypoint": [{"time": 5.0, "position": [0.2, 0.2, 4.05]}]}))
    assert maneuver.status == "blocked"
    assert re.match(r"step \d+: tracking: Newton's method .+ for the joints up to ", maneuver.blocked_by[0])
