"""Starts that break a limit, obstacles that move, angles, offset joints: what recovers, and what never gets worse."""

from __future__ import annotations

import dataclasses
import json

import modules
import numpy as np
import pytest
from arms import mast
from recovery_problems import BASE, box, problem

import vgtm_qp as vq
from vgtm_qp.arm.truss.arm import TrussArm, truss_of
from vgtm_qp.cli import main
from vgtm_qp.methods import Resolver
from vgtm_qp.step.separation import Separation


def beside(gap):
    """Return a box whose face is `gap` from the surface of the home arm, on the side of x."""
    home = truss_of(Resolver(problem()).setup.arm)
    reach = float(home.home[:, 0].max()) + float(home.radius.max())
    return box("crate", [reach + gap + 0.25, 0.0, 1.2], [0.5, 2.0, 2.0])


def test_an_arm_too_near_at_the_start_recovers_monotonically_and_says_so():
    resolver = Resolver(problem(obstacle=[beside(0.03)]))
    setup = resolver.setup
    kept = Separation(setup)
    before = kept.shortfall(resolver.state.q, 0.0)
    assert before
    assert any("crate" in setup.monitor.names.clearance(pair) for pair in before)
    short, least = dict(before), min(before.values())
    tip, _ = resolver.tip()
    for k in range(12):
        resolver.step(position=tip + (k + 1) * np.array([0.0, 0.02, -0.005]), dt=0.2)
        after = resolver.state.shortfall
        for pair, distance in after.items():
            assert distance >= short[pair] - 1e-9
        now = setup.monitor.least(resolver.state.nodes, resolver.state.time, among="obstacles")[0]
        assert now >= min(least, setup.safe) - 1e-9
        short, least = dict(after), now
    assert not short
    assert least >= setup.safe - 1e-9


def test_a_maneuver_from_a_start_that_is_too_near_is_solved_and_its_verification_tells():
    maneuver = vq.solve(problem(obstacle=[beside(0.05)]))
    assert maneuver.status == "solved"
    assert np.all(np.diff(np.minimum(maneuver.clearance, 0.08)) >= -1e-9)
    assert maneuver.clearance[-1] >= 0.08 - 1e-9
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    record = maneuver.manifest["recovered"]
    assert all(entry["pair"].endswith(" / crate") for entry in record)
    assert min(entry["distance"] for entry in record) == pytest.approx(0.05, abs=1e-9)
    assert any(line.startswith("recovered: ") for line in maneuver.certificate.notes)


def recovered():
    return vq.solve(problem(obstacle=[beside(0.05)]))


def test_a_pair_that_is_too_near_without_being_on_record_is_a_failure():
    maneuver = recovered()
    maneuver.manifest["recovered"] = maneuver.manifest["recovered"][1:]
    assert any(line.startswith("clearance: ") for line in vq.verify(maneuver).failures())


def test_a_record_of_another_distance_or_of_no_pair_is_a_failure():
    maneuver = recovered()
    maneuver.manifest["recovered"][0]["distance"] += 1e-3
    assert any("apart at home" in line for line in vq.verify(maneuver).failures())
    maneuver = recovered()
    maneuver.manifest["recovered"].append({"pair": "nothing / crate", "distance": 0.01})
    assert any("do not have" in line for line in vq.verify(maneuver).failures())
    maneuver.manifest["recovered"] = [{"distance": 0.01}]
    with pytest.raises(vq.ResultError, match="recovered"):
        vq.verify(maneuver)


def test_a_recovering_pair_that_comes_nearer_again_is_a_failure():
    maneuver = recovered()
    nodes = maneuver.nodes.copy()
    nodes[2] = nodes[0]
    lines = vq.verify(dataclasses.replace(maneuver, nodes=nodes)).failures()
    assert any(line.startswith("recovered: ") and "at state 2" in line for line in lines)
    nodes = maneuver.nodes.copy()
    nodes[-1] = nodes[0]
    lines = vq.verify(dataclasses.replace(maneuver, nodes=nodes)).failures()
    assert any(line.startswith("clearance: ") for line in lines)


def test_a_recovery_is_solved_and_verified_from_the_command_line(tmp_path, capsys):
    file, result = tmp_path / "near.toml", tmp_path / "near.npz"
    crate = beside(0.05)
    tables = [
        *(
            f"[{key}]\n" + "".join(f"{k} = {json.dumps(v)}\n" for k, v in BASE[key].items())
            for key in ("truss", "curve", "clearance", "method")
        ),
        "[maneuver]\nsteps = 20\n[[maneuver.waypoint]]\ntime = 4.0\nposition = [0.0, 0.5, 2.2]\n",
        "[[obstacle]]\n" + "".join(f"{k} = {json.dumps(v)}\n" for k, v in crate.items()),
    ]
    file.write_text('schema_version = 1\nname = "near"\n' + "\n".join(tables))
    assert main(["solve", str(file), "--output", str(result)]) == 0
    capsys.readouterr()
    assert main(["verify", str(result)]) == 0
    assert "note  recovered: pairs too near at home" in capsys.readouterr().out


@pytest.mark.parametrize("speed", [0.08, 0.1])
def test_an_arm_gives_way_to_an_obstacle_that_comes_nearer(speed):
    crate = box("crate", [1.05, 0.0, 2.5], [0.5, 2.0, 1.0], velocity=[-speed, 0.0, 0.0])
    maneuver = vq.solve(problem(obstacle=[crate]))
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    assert maneuver.status == "solved"
    careless = vq.solve(problem()).nodes[-1]
    assert (
        Resolver(problem(obstacle=[crate])).setup.monitor.least(careless, 4.0, among="obstacles")[0]
        < 0.08 - 1e-3
    )


def test_members_keep_a_quarter_of_safe_from_one_another_unless_told_otherwise():
    assert problem().clearance.between_members == pytest.approx(0.02)
    assert problem(**{"clearance.self_safe": 0.05}).clearance.between_members == 0.05
    assert Resolver(problem()).setup.self_safe == pytest.approx(0.02)
    for name in ("five_bay_two_cubes", "five_bay_two_cubes_pointing"):
        maneuver = vq.solve(vq.load_problem(name))
        assert (maneuver.status, len(maneuver.time)) == ("solved", 51)
        assert maneuver.certificate.ok, maneuver.certificate.failures()
        assert maneuver.self_clearance.min() >= 0.02 - 1e-9


def test_self_clearance_is_reported_where_it_is_not_kept():
    maneuver = vq.solve(problem(**{"clearance.self_collision": False}))
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    assert np.all(np.isfinite(maneuver.self_clearance))


@pytest.mark.smoke
def test_the_least_angle_between_members_that_meet_is_kept():
    goal = {"maneuver.waypoint": [{"time": 4.0, "position": [0.9, 0.0, 1.9]}]}
    free = vq.solve(problem(**goal)).certificate.member_angle.value
    least = free + 0.1
    bound = vq.solve(problem(**goal, **{"clearance.minimum_angle": least}))
    assert bound.certificate.ok, bound.certificate.failures()
    assert least - 1e-6 <= bound.certificate.member_angle.value <= least + 0.05
    if bound.status != "solved":
        assert any(name.startswith("angle: ") for name in bound.blocked_by)


@pytest.mark.parametrize("truss", [modules.octahedral(2, joint_offset=0.1), mast(0.1)])
def test_ends_of_offset_joints_stay_within_the_bound_of_their_chords(truss, rng):
    arm = TrussArm(truss)
    for size in (0.01, 0.05, 0.2):
        start = truss.home + rng.uniform(-0.05, 0.05, truss.home.shape)
        end = start + rng.uniform(-size, size, start.shape)
        bound = 0.5 * arm.deviation(start, end)
        first, last = truss.member_ends(start), truss.member_ends(end)
        worst = max(
            float(
                np.linalg.norm(
                    truss.member_ends(start + s * (end - start)) - (first + s * (last - first)), axis=2
                ).max()
            )
            for s in np.linspace(0.05, 0.95, 19)
        )
        assert worst <= bound
        if size < 0.1:
            assert bound < 100.0 * worst
    still = truss.home[[0] * len(truss.home)]
    assert arm.deviation(still, still) == np.inf
    pins = TrussArm(modules.octahedral(2))
    assert pins.deviation(pins.home, pins.home + 0.1) == 0.0


def test_offset_joints_pass_cubes_with_clearance_between_their_true_ends():
    maneuver = vq.solve(
        problem(**{"truss.joint_offset": 0.06, "truss.stroke": [0.5, 1.35], "obstacle": [beside(0.1)]})
    )
    assert maneuver.status == "solved"
    assert maneuver.certificate.ok, maneuver.certificate.failures()


def changes_of_rates(problem):
    """Return the maneuver and (T - 2,) by how much all actuators' rates change from each step to the next, m/s."""
    maneuver = vq.solve(problem)
    assert maneuver.status == "solved"
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    rate = np.diff(maneuver.member_lengths, axis=0) / np.diff(maneuver.time)[:, None]
    return maneuver, np.abs(np.diff(rate, axis=0)).sum(axis=1)


def sliding():
    free = vq.load_problem("five_bay_free").replace(
        {"maneuver.waypoint": [{"time": 10.0, "position": [1.2, 0.4, 3.5]}]}
    )
    return free, free.replace({"obstacle": [box("cube", [0.0, 3.05, 2.0], 4.5)]})


def test_a_member_that_slides_along_a_cube_does_not_chatter():
    """Several witness rows on parallel faces: actuator rates change no more than twice as much as in free motion."""
    free, beside_a_face = (changes_of_rates(scene) for scene in sliding())
    assert np.count_nonzero(beside_a_face[0].clearance < 0.0806) > 30
    assert beside_a_face[1].sum() <= 1.5 * free[1].sum()
    assert beside_a_face[1].max() <= 0.1


def test_members_that_touch_at_full_speed_jolt_all_actuators():
    _, scene = sliding()
    slow, abrupt = (
        changes_of_rates(scene.replace({"method.slow_approach": value}))[1] for value in (True, False)
    )
    assert slow.max() <= 0.4 * abrupt.max()
    assert slow.sum() <= 0.9 * abrupt.sum()


@pytest.mark.parametrize(
    ("mode", "within", "jolt", "sum_of"), [("elastic", 2.6, 0.4, 0.9), ("exact", 3.0, 0.9, 0.95)]
)
def test_contacts_with_two_cubes_do_not_jolt_the_arm_and_what_they_add_is_within_free_motion(
    mode, within, jolt, sum_of
):
    """Free of the ends of its strokes: those add as much again as the cubes."""
    cubes = vq.load_problem("five_bay_two_cubes").replace({"method.tracking_mode": mode})
    free = changes_of_rates(cubes.replace({"obstacle": []}))[1].sum()
    _, changes = changes_of_rates(cubes.replace({"truss.stroke": [0.4, 1.7]}))
    assert changes.sum() <= 2.0 * free
    _, changes = changes_of_rates(cubes)
    assert changes.sum() <= within * free
    _, abrupt = changes_of_rates(cubes.replace({"method.slow_approach": False}))
    assert changes.max() <= jolt * abrupt.max()
    assert changes.sum() <= sum_of * abrupt.sum()


def test_an_arm_at_rest_need_not_flee_from_an_obstacle_that_only_comes_nearer():
    crate = box("crate", [1.3, 0.0, 1.5], [0.5, 2.0, 2.0], velocity=[-0.3, 0.0, 0.0])

    def of_the_crate(resolver):
        """Lower bounds of its rows in the QP of a step of one second that goes nowhere."""
        qp = resolver.build(position=resolver.tip()[0], dt=1.0)
        return [qp.row_lower[k] for k, row in enumerate(qp.rows) if row.name.endswith(" / crate")]

    coming = of_the_crate(Resolver(problem(obstacle=[crate])))
    assert coming
    assert max(coming) < 0.0
    resting = Resolver(problem(obstacle=[{**crate, "velocity": [0.0, 0.0, 0.0]}]))
    least = max(of_the_crate(resting))
    room = resting.setup.monitor.least(resting.state.nodes, 0.0, among="obstacles")[0] - resting.setup.safe
    assert least == pytest.approx(-0.4 * room, abs=1e-3)
