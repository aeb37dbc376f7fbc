"""What would let a stopped arm go on: few changes, told alike everywhere, and with them it does go on."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from arms import three_bays

import vgtm_qp as vq
from vgtm_qp.cli import main
from vgtm_qp.compiled import finish_compiling
from vgtm_qp.errors import ResultError
from vgtm_qp.export.html import read_out
from vgtm_qp.maneuver.solve import STALLED_STEPS, ManeuverAttempt, helpful_remedies
from vgtm_qp.methods import Resolver, with_method
from vgtm_qp.step.first_order import ANGLE, CLEARANCE, MEMBERS, Limit
from vgtm_qp.step.remedies import Change, Remedy, relaxed, remedies, resorts
from vgtm_qp.step.stops import StopKind

WALL = {"name": "wall", "shape": "box", "center": [1.2, 0.0, 2.0], "size": [0.3, 6.0, 6.0]}


def stopped(problem):
    """Return the attempt at a problem and the stop that stays, or None."""
    attempt = ManeuverAttempt(problem, Resolver(problem))
    return attempt, attempt.resumed(attempt.run(None), None)


def random_problem(random):
    """Return an arm with random strokes and boxes beside it, and a goal that it seldom reaches."""
    boxes = []
    for k in range(int(random.integers(1, 4))):
        center = [random.uniform(0.95, 1.2), random.uniform(-0.8, 0.8), random.uniform(1.0, 2.3)]
        boxes.append({"name": f"box {k}", "shape": "box", "center": center, "size": random.uniform(0.3, 0.6)})
    changes = {
        "truss.stroke": [random.uniform(0.5, 0.8), random.uniform(1.2, 1.5)],
        "maneuver.waypoint": [
            {"time": 4.0, "position": [random.uniform(0.8, 1.5), 0.0, random.uniform(1.3, 2.2)]}
        ],
    }
    return three_bays(obstacle=boxes, **changes)


@pytest.mark.dear
def test_what_is_named_lets_the_arm_go_on_and_nothing_else_does(rng):
    """Of random stops at most one in ten has no remedy, and no arm goes on as it is."""
    stops, helped = 0, 0
    while stops < 10:
        try:
            attempt, stop = stopped(problem := random_problem(rng))
        except vq.ProblemError:
            continue
        if stop is None or stop.kind in (StopKind.OUT_OF_REACH, StopKind.SINGULAR):
            continue
        stops += 1
        kept = attempt.resolver.state
        tried = helpful_remedies(attempt, stop)
        helped += bool(tried)
        assert not attempt.goes_on(Remedy((), 1.0)), str(stop)
        assert len(tried) <= 3
        for remedy in tried:
            assert 1 <= len(remedy.changes) <= 3
            again = ManeuverAttempt(problem, attempt.resolver.relaxed(remedy))
            again.plan, again.value = attempt.plan, attempt.value
            again.resumed(again.run(None), None)
            assert again.progress > attempt.progress, str(remedy)
        assert attempt.resolver.state is kept
    assert helped >= stops - 1, (helped, stops)


def test_an_arm_that_stalls_and_is_free_in_a_later_step_goes_on():
    box = {"shape": "box", "center": [1.066, 0.0528, 1.2058], "size": 0.6282}
    other = {"shape": "box", "center": [1.0632, -0.5146, 2.0563], "size": 0.645}
    problem = three_bays(
        obstacle=[{**box, "name": "low"}, {**other, "name": "high"}],
        **{
            "truss.stroke": [0.7459, 1.209],
            "maneuver.waypoint": [{"time": 4.0, "position": [0.9824, 0.0, 2.0167]}],
        },
    )
    # Where it stalls, the last digits of kernels that are compiled meanwhile would decide.
    ManeuverAttempt(problem, Resolver(problem)).run(None)
    finish_compiling()
    attempt = ManeuverAttempt(problem, Resolver(problem))
    stop = attempt.run(None)
    stalled = attempt.progress
    assert attempt.goes_on(Remedy((), 1.0)), "else this scene shows nothing any more"
    assert attempt.resumed(stop, None) is not None
    assert attempt.progress > stalled + 0.01
    assert not attempt.goes_on(Remedy((), 1.0))
    assert vq.solve(problem.replace({"method.retries": False})).reached == pytest.approx(attempt.progress)


def test_an_arm_that_gains_nothing_gives_up_whatever_was_foretold(monkeypatch):
    """What is tried and what is done may differ for ever, in their last digits."""
    problem = three_bays(
        obstacle=[WALL], **{"maneuver.waypoint": [{"time": 4.0, "position": [1.1, 0.0, 1.9]}]}
    )
    attempt = ManeuverAttempt(problem, Resolver(problem))
    stop = attempt.run(None)
    assert stop is not None
    attempt.stalled = STALLED_STEPS
    monkeypatch.setattr(attempt, "goes_on", lambda _: True)
    assert attempt.resumed(stop, None) is not None


def test_an_obstacle_may_be_out_of_the_way_but_not_the_arm_itself():
    setup = Resolver(three_bays(obstacle=[WALL])).setup

    class Free:
        progress, names, limits = 1.0, (), ()

        def without(self, limits):
            return float(bool(limits)), np.ones(2)

        def least_changes(self, limits, most):
            return np.full(len(limits), 99.0) if all(map(math.isinf, most)) else None

    for limit, text in ((Limit(CLEARANCE, "wall"), "out of the way"), (Limit(MEMBERS), "mm less clearance")):
        program = Free()
        program.limits = (limit, limit)
        (remedy,) = remedies(setup, program)
        assert text in str(remedy)


def test_a_remedy_of_the_wall_is_its_clearance_and_it_frees_the_arm_from_home_too():
    problem = three_bays(
        obstacle=[WALL], **{"maneuver.waypoint": [{"time": 4.0, "position": [1.1, 0.0, 1.9]}]}
    )
    blocked = vq.solve(problem)
    assert blocked.status == "blocked"
    (change,) = blocked.remedies[0]
    assert (change["kind"], change["name"], change["unit"]) == ("clearance", "wall", "m")
    assert 0.0 < change["amount"] <= 0.05
    nearer = {"clearance.safe": 0.05 - change["amount"]}
    assert vq.solve(problem.replace(nearer)).reached > blocked.reached + 1e-3


def test_more_stroke_frees_a_stretched_arm_and_less_than_is_named_does_not_get_as_far():
    waypoint = [{"time": 4.0, "position": [0.9, 0.0, 1.7]}]
    problem = three_bays(**{"truss.stroke": [0.8, 1.2], "maneuver.waypoint": waypoint})
    attempt, stop = stopped(problem)
    assert stop is not None
    (remedy, *_) = helpful_remedies(attempt, stop)
    assert {change.limit.kind for change in remedy.changes} == {"stroke"}

    def reached(factor):
        again = ManeuverAttempt(problem, attempt.resolver.relaxed(remedy.times(factor)))
        again.plan, again.value = attempt.plan, attempt.value
        again.run(None)
        return again.progress

    assert attempt.progress < reached(1.0)
    assert reached(0.2) < reached(1.0)


def test_command_certificate_page_and_maneuver_tell_the_same_sentence(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["solve", "five_bay_blocked_by_wall", "-o", "wall.npz"]) == 3
    out = capsys.readouterr().out
    maneuver = vq.load_result("wall.npz")
    sentence = maneuver.stopped_by
    assert sentence.startswith("obstacle; to go on: wall: ")
    assert sentence.endswith(" mm less clearance")
    assert [line for line in out.splitlines() if "stopped by" in line] == [f"  stopped by {sentence}"]
    assert f"stopped by {sentence}" in maneuver.certificate.notes
    assert f"Stopped by {sentence}." in str(maneuver)
    assert maneuver.why_not == sentence
    assert read_out(maneuver, float(maneuver.time[-1]), 0.1).endswith(f"blocked: {sentence}")
    summary = maneuver.summary()
    assert summary["stopped_by"] == sentence
    assert summary["blocked_by"] == list(maneuver.blocked_by)
    assert summary["remedies"] == maneuver.remedies
    assert all(change["text"] in sentence for remedy in maneuver.remedies for change in remedy)
    json.dumps(summary, allow_nan=False)
    assert main(["verify", "wall.npz", "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["results"][0]["stopped_by"] == sentence


def test_limits_that_give_are_those_that_are_named_and_no_others():
    setup = Resolver(three_bays(obstacle=[WALL, {**WALL, "name": "other", "center": [-1.2, 0.0, 2.0]}])).setup
    name = setup.arm.quantity_names[int(setup.arm.actuators[4])]
    changes = (
        Change(Limit(CLEARANCE, "wall"), 0.02, "m"),
        Change(Limit(MEMBERS), 1.0, "m"),
        Change(Limit(ANGLE), 0.1, "rad"),
        Change(Limit("stroke", name, upper=False), 0.03, "m"),
        Change(Limit("rate"), 0.4, "m/s"),
    )
    other = relaxed(setup, changes)
    points = setup.arm.points(setup.arm.home_configuration)
    before, after = setup.monitor.near(points, 0.0, 2.0), other.monitor.near(points, 0.0, 2.0)
    least = {}
    for key, contacts in (("before", before), ("after", after)):
        for k in range(len(contacts)):
            pair = contacts.pair(k)
            least.setdefault(pair, {})[key] = float(contacts.distance[k])
    seen = set()
    for pair, distance in least.items():
        if "before" in distance and "after" in distance:
            allowed = 0.02 if setup.monitor.names.clearance(pair).endswith(" / wall") else 0.0
            assert distance["after"] - distance["before"] == pytest.approx(allowed, abs=1e-6)
            seen.add(allowed)
    assert seen == {0.0, 0.02}
    assert other.self_safe == other.minimum_angle == 0.0
    row = setup.arm.quantity_names.index(name)
    widened = setup.arm.stroke.copy()
    widened[row, 0] -= 0.03
    np.testing.assert_array_equal(other.arm.stroke, widened)
    actuators = setup.arm.actuators
    np.testing.assert_allclose(other.arm.rate[actuators], setup.arm.rate[actuators] + 0.4)
    gone = relaxed(setup, [Change(Limit(CLEARANCE, "wall"), math.inf, "m")])
    assert [obstacle.name for obstacle in gone.monitor.obstacles] == ["other"]


def test_changes_read_as_people_say_them():
    told = {
        Change(Limit(CLEARANCE, "right cube"), 0.012, "m"): "right cube: 12 mm less clearance",
        Change(Limit(CLEARANCE, "right cube"), math.inf, "m"): "right cube: out of the way",
        Change(Limit("stroke", "B4-3"), 0.008, "m"): "B4-3: 8 mm more stroke at its upper end",
        Change(Limit("stroke", "B4-3", upper=False), 1.25, "m"): "B4-3: 1.25 m more stroke at its lower end",
        Change(
            Limit("stroke", "elbow"), math.radians(3.0), "rad"
        ): "elbow: 3 degrees more stroke at its upper end",
        Change(Limit("rate"), 0.05, "m/s"): "all actuators: 50 mm/s more rate",
        Change(Limit(MEMBERS), 0.02, "m"): "bodies of the arm: 20 mm less clearance",
        Change(Limit(ANGLE), math.radians(2.0), "rad"): "bodies that meet: 2 degrees less angle",
    }
    assert {change: str(change) for change in told} == told
    for change in told:
        more = change.times(2.0)
        assert 2.0 * change.amount <= more.amount <= 2.2 * change.amount
    change = Change(Limit(CLEARANCE, "right cube"), 0.05, "m", 0.08)
    assert change.times(2.0).amount == 0.08, "no clearance below zero"


@pytest.mark.parametrize("stop", [{"text": 5}, {"remedies": 5}, {"remedies": ["none"]}, {"remedies": [[3]]}])
def test_a_malformed_stop_is_refused(stop):
    maneuver = vq.solve(three_bays(**{"maneuver.steps": 2}), verify=False)
    with pytest.raises(ResultError, match=r"manifest\.stop"):
        replace(maneuver, manifest={**maneuver.manifest, "stop": stop})


def test_a_serial_arm_that_is_held_by_its_joints_has_a_remedy_in_degrees():
    problem = vq.load_problem("snake_past_a_cube").replace({"maneuver.steps": 20, "method.retries": False})
    joints = [{**joint, "limits": [-0.12, 0.12]} for joint in problem.to_dict()["arm"]["joint"]]
    maneuver = vq.solve(problem.replace({"arm.joint": joints, "obstacle": []}))
    assert maneuver.status == "blocked"
    assert {change["unit"] for remedy in maneuver.remedies for change in remedy} == {"rad"}
    assert " degrees more stroke at its " in maneuver.stopped_by


def test_a_method_without_rows_says_why_in_its_own_words():
    problem = vq.load_problem("five_bay_two_cubes").replace({"maneuver.steps": 30})
    maneuver = vq.solve(with_method(problem, "curve-pseudoinverse-plain"))
    assert maneuver.status == "blocked"
    assert maneuver.stopped_by == maneuver.blocked_by[0]
    assert maneuver.remedies == []


def test_a_step_limit_is_named_with_an_amount_that_suffices():
    problem = three_bays(
        **{
            "end_effector.mode": "hard",
            "method.step_limit": 0.013,
            "maneuver.steps": 4,
            "maneuver.waypoint": [{"time": 8.0, "position": [0.3, 0.0, 2.5]}],
        }
    )
    blocked = vq.solve(problem)
    assert blocked.status == "blocked"
    assert blocked.manifest["stop"]["kind"] == "step limit"
    ((change,),) = blocked.remedies
    assert (change["kind"], change["unit"]) == ("step limit", "m")
    assert f"method.step_limit: {1000.0 * change['amount']:.3g} mm more" in blocked.stopped_by
    assert (
        vq.solve(problem.replace({"method.step_limit": 0.013 + change["amount"]})).reached > blocked.reached
    )


def test_accelerations_are_named_where_they_hold_a_tip_that_must_not_be_late():
    problem = three_bays(
        **{
            "end_effector.mode": "hard",
            "truss.acceleration": 0.02,
            "maneuver.steps": 6,
            "maneuver.waypoint": [{"time": 2.0, "position": [0.5, 0.0, 2.3]}],
        }
    )
    blocked = vq.solve(problem)
    assert blocked.status == "blocked"
    changes = [change for remedy in blocked.remedies for change in remedy]
    assert {change["kind"] for change in changes} == {"acceleration"}
    assert changes[0]["unit"] == "m/s^2"
    assert " more acceleration" in blocked.stopped_by
    more = problem.replace({"truss.acceleration": 0.02 + changes[0]["amount"]})
    assert vq.solve(more).reached > blocked.reached


def test_resorts_are_the_named_limits_and_at_last_the_obstacle_out_of_the_way():
    setup = Resolver(three_bays(obstacle=[WALL])).setup
    name = setup.arm.quantity_names[int(setup.arm.actuators[4])]
    rows = [f"stroke: {name}", "clearance: member B1-1 / wall", "rate: B1-2", "angle: B1-1 / B1-2"]
    longest = setup.arm.stroke[:, 1]
    found = list(resorts(setup, longest, [*rows, "locked: B1-3"], ()))
    kinds = [[change.limit.kind for change in remedy.changes] for remedy in found]
    assert kinds[:3] == [["stroke"], ["stroke", "clearance"], ["stroke", "clearance", "rate"]]
    assert found[0].changes[0].limit == Limit("stroke", name, upper=True)
    assert [change.limit.name for change in found[3].changes] == ["", "wall", ""]
    assert [math.isinf(change.amount) for change in found[4].changes] == [True]
    assert math.isinf(found[5].changes[0].amount)
    assert all(len(remedy.changes) <= 3 for remedy in found)
    two = (
        Remedy((Change(Limit(ANGLE), 0.1, "rad"),), 1.0),
        Remedy((Change(Limit("rate"), 0.1, "m/s"),), 1.0),
    )
    assert [change.limit.kind for change in next(resorts(setup, longest, rows, two)).changes] == [
        "angle",
        "rate",
    ]


def test_what_is_locked_stays_where_it_is_with_the_limits_of_a_remedy():
    """A resolver with other limits is built at home; its locks hold what they find."""
    resolver = vq.Resolver(vq.load_problem("five_bay_free"))
    start = resolver.tip()[0]
    for k in range(12):
        resolver.step(position=start + np.array([0.05 * k, 0.0, -0.03 * k]))
    resolver.lock("B5-3")
    more = Change(Limit("rate", ""), 0.1, "m/s")
    other, k = resolver.relaxed(Remedy((more,), 1.0)), resolver.setup.arm.quantity_names.index("B5-3")
    held = resolver.state.quantities[k]
    assert abs(held - resolver.setup.home_state().quantities[k]) > 0.1
    for j in range(5):
        assert other.step(position=start + np.array([0.6 + 0.05 * j, 0.0, -0.4])).moved
    assert other.state.quantities[k] == pytest.approx(held, abs=1e-9)
