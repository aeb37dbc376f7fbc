"""A scene that changes while the arm runs: answers as if it had always been so, and each step proven in its own."""

from __future__ import annotations

import json
import threading
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from arms import three_bays

import vgtm_qp as vq
from vgtm_qp.errors import ResultError
from vgtm_qp.geometry import shapes
from vgtm_qp.geometry.bodies import capsules
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.methods import with_method
from vgtm_qp.step.build import make_obstacle
from vgtm_qp.view.drawing import drawing_of_maneuver

CUBE = {"name": "cube", "shape": "box", "center": [1.3, 0.0, 2.0], "size": 0.5}


def random_obstacle(random, name, mesh_file):
    """Return an obstacle of any shape beside an arm of three bays."""
    way = random.normal(size=3) * np.array([1.0, 1.0, 0.3])
    where = {
        "name": name,
        "center": np.array([0.0, 0.0, 1.5]) + random.uniform(1.2, 1.8) * way / np.linalg.norm(way),
    }
    if random.random() < 0.3:
        where["velocity"] = random.uniform(-0.05, 0.05, size=3)
    turned = {**where, "rotation_vector": random.normal(size=3)}
    return random.choice(
        [
            vq.Box(**turned, size=random.uniform(0.1, 0.5, size=3)),
            vq.Sphere(**where, radius=random.uniform(0.1, 0.3)),
            vq.Cylinder(**turned, radius=random.uniform(0.1, 0.3), height=random.uniform(0.1, 0.5)),
            vq.Mesh(**turned, file=mesh_file, scale=random.uniform(0.2, 0.4)),
        ]
    )


def change(resolver, random, mesh_file):
    """Change the scene of a resolver at random, and return what is too near afterwards."""
    names = [obstacle.name for obstacle in resolver.obstacles]
    kind = random.choice(["add", "move", "turn", "stop", "remove", "clearance"])
    if kind == "clearance":
        return resolver.set_clearance(safe=random.uniform(0.02, 0.12), self_safe=random.uniform(0.0, 0.02))
    if kind == "add" or not names:
        fresh = next(f"thing {k}" for k in range(100) if f"thing {k}" not in names)
        return resolver.add_obstacle(random_obstacle(random, fresh, mesh_file))
    name = str(random.choice(names))
    if kind == "remove":
        return resolver.remove_obstacle(name) or {}
    if kind == "move":
        here = dict(zip(names, resolver.setup.monitor.pieces.at(resolver.state.time)[:, :3], strict=False))
        return resolver.move_obstacle(name, center=here[name] + random.normal(scale=0.05, size=3))
    if kind == "turn" and not isinstance(resolver.obstacles[names.index(name)], vq.Sphere):
        return resolver.move_obstacle(name, rotation_vector=random.normal(size=3))
    return resolver.move_obstacle(name, velocity=[0.0, 0.0, 0.0])


@pytest.fixture
def mesh_file(tmp_path):
    """Return the file of a closed mesh with faces that are not parallel."""
    path = tmp_path / "stone.stl"
    trimesh.creation.icosahedron().export(path)
    return str(path)


def test_answers_after_changes_are_those_of_a_scene_made_anew(rng, mesh_file):
    resolver = vq.Resolver(three_bays(obstacle=[CUBE]))
    setup, tip = resolver.setup, resolver.tip()[0]
    for k in range(25):
        change(resolver, rng, mesh_file)
        changed, time = setup.monitor, resolver.state.time
        anew = Clearance(
            changed.bodies,
            [make_obstacle(table) for table in resolver.obstacles],
            safe=changed.safe,
            self_safe=changed.self_safe,
            influence=changed.influence,
            unit=setup.arm.unit,
        )
        points = setup.arm.points(resolver.state.q) + 0.01 * rng.normal(size=3)
        for among in ("all", "obstacles", "members"):
            assert changed.least(points, time, among=among)[0] == pytest.approx(
                anew.least(points, time, among=among)[0], abs=1e-12
            )
        for tracked in (False, True):
            rows = [monitor.near(points, time, tracked=tracked) for monitor in (changed, anew)]
            named = [
                sorted((found.name(k), round(float(found.distance[k]), 9)) for k in range(len(found)))
                for found in rows
            ]
            assert named[0] == named[1]
        further = points + 0.02 * rng.normal(size=points.shape)
        proofs = [
            monitor.along(np.stack([points, further]), time, time + 0.1, 0.03, 0.005)
            for monitor in (changed, anew)
        ]
        assert proofs[0].certified == proofs[1].certified
        resolver.step(position=tip + 0.1 * np.sin([0.3 * k, 0.2 * k, 0.1 * k]), dt=0.1)


def test_a_recording_through_random_changes_is_verified(rng, mesh_file):
    """Steps are proven in the scene of their time; pairs that are too near at once only come apart."""
    problem = three_bays(obstacle=[CUBE])
    resolver = vq.Resolver(problem)
    tip, recording = resolver.tip()[0], vq.Recording(resolver, problem)
    changes = 0
    for k in range(60):
        if rng.random() < 0.3 and not resolver.state.shortfall:
            name = f"thing {k}"
            thing = random_obstacle(rng, name, mesh_file)
            changes += 1
            if any(distance < 0.0 for distance in resolver.add_obstacle(thing).values()):
                resolver.remove_obstacle(name)
            elif rng.random() < 0.4:
                resolver.move_obstacle(name, velocity=rng.uniform(-0.02, 0.02, size=3))
            if len(resolver.obstacles) > 3:
                resolver.remove_obstacle(resolver.obstacles[0].name)
        resolver.step(position=tip + 0.2 * np.sin([0.3 * k, 0.2 * k, 0.0]), dt=0.1)
    maneuver = recording.maneuver()
    certificate = vq.verify(maneuver)
    assert certificate.ok, str(certificate)
    assert len(maneuver.time) == len(recording) + 1
    assert len(maneuver.manifest.get("scenes", ())) <= changes
    assert np.isfinite(maneuver.step_time[1:]).all()


def test_the_record_of_a_loop_says_in_which_scene_each_step_was_made(tmp_path):
    problem = three_bays(obstacle=[CUBE])
    resolver = vq.Resolver(problem)
    tip, recording = resolver.tip()[0], vq.Recording(resolver, problem)
    for k in range(12):
        if k == 4:
            assert resolver.add_obstacle(vq.Sphere(name="ball", center=[-0.9, 0.0, 2.5], radius=0.2)) == {}
        if k == 8:
            resolver.remove_obstacle("ball")
            resolver.set_clearance(safe=0.08)
        resolver.step(position=np.add(tip, [0.01 * k, 0.0, 0.0]))
    maneuver = recording.maneuver()
    scenes = maneuver.manifest["scenes"]
    assert [scene["row"] for scene in scenes] == [4, 8]
    assert [[table["name"] for table in scene["obstacle"]] for scene in scenes] == [
        ["cube", "ball"],
        ["cube"],
    ]
    assert [scene["safe"] for scene in scenes] == [0.05, 0.08]
    maneuver.save(tmp_path / "loop.npz")
    certificate = vq.verify_file(tmp_path / "loop.npz")
    assert certificate.ok
    assert any("the scene changed at states 4, 8" in note for note in certificate.notes)
    assert any("the scene changed" in line for line in vq.verify(maneuver, problem=problem).contradictions)

    def edited(**changes):
        scenes = json.loads(json.dumps(maneuver.manifest["scenes"]))
        scenes[0].update(changes)
        return replace(maneuver, manifest={**maneuver.manifest, "scenes": scenes})

    through = {**scenes[0]["obstacle"][0], "center": [0.0, 0.0, 1.5]}
    assert vq.verify(edited(obstacle=[through])).clearance.value < 0.0
    assert not vq.verify(edited(safe=0.45, recovered=[])).ok
    for wrong in (
        {"row": 9},
        {"row": 0.5},
        {"row": None},
        {"obstacle": [{"shape": "cone"}]},
        {"safe": "much"},
    ):
        with pytest.raises(ResultError, match=r"manifest\."):
            vq.verify(edited(**wrong))


def test_an_obstacle_that_will_be_in_the_way_stops_the_arm_and_lets_it_go_when_it_is_gone():
    resolver = vq.Resolver(three_bays())
    tip = resolver.tip()[0]
    goal = np.add(tip, [0.9, 0.0, -0.3])
    resolver.add_obstacle(vq.Box(name="door", center=[0.85, 0.0, tip[2]], size=[0.1, 2.0, 2.0]))
    for _ in range(40):
        step = resolver.step(position=goal)
    assert step.status is not vq.StepStatus.REACHED
    assert any("door" in name for name in step.blocked_by)
    resolver.remove_obstacle("door")
    for _ in range(30):
        step = resolver.step(position=goal)
    assert step.status is vq.StepStatus.REACHED


def test_a_pose_nearer_than_the_new_clearance_says_so_and_recovers():
    resolver = vq.Resolver(three_bays(obstacle=[{**CUBE, "center": [0.95, 0.0, 1.5]}]))
    near = resolver.set_clearance(safe=0.25)
    assert near
    assert all(name.endswith(" / cube") and 0.0 < distance < 0.25 for name, distance in near.items())
    assert resolver.state.shortfall
    least = min(near.values())
    for _ in range(60):
        resolver.step(position=resolver.tip()[0])
        short = resolver.state.shortfall or {}
        assert min(short.values(), default=0.25) >= least - 1e-9
        least = min(short.values(), default=0.25)
        if not short:
            break
    assert not resolver.state.shortfall


def test_a_pair_with_a_floor_of_its_own_lowers_no_other():
    """The one too near may come apart, the other has to keep its clearance all the way."""
    obstacles = [shapes.sphere("near", [0.4, 0.0, 0.5], 0.3), shapes.sphere("far", [-0.45, 0.0, 0.5], 0.3)]
    monitor = Clearance(capsules([[0, 1]], 0.05), obstacles, safe=0.08, influence=0.5)
    start = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

    def failing(shift, least):
        places = np.stack([start, start + np.array([shift, 0.0, 0.0])])
        report = monitor.along(places, 0.0, 0.1, 0.08, lowered={(0, 0, False): least})
        assert report.certified == (not len(report.failing))
        return {report.failing.name(k).rpartition(" / ")[2] for k in range(len(report.failing))}

    assert failing(-0.015, 0.05) == set()
    assert failing(-0.04, 0.05) == {"far"}
    assert failing(0.01, 0.05) == {"near"}
    assert failing(0.01, -np.inf) == set()
    assert failing(-0.04, -np.inf) == {"far"}


def test_what_an_arm_cannot_brake_before_is_told_at_once():
    problem = three_bays(**{"truss.acceleration": 0.2, "truss.rate": 0.5})
    resolver = vq.Resolver(problem)
    tip = resolver.tip()[0]
    for _ in range(12):
        resolver.step(position=np.add(tip, [0.9, 0.0, -0.3]), dt=0.1)
    nodes = resolver.state.nodes
    wall = {"name": "wall", "center": [nodes[:, 0].max() + 0.12, 0.0, 2.0], "size": [0.02, 4.0, 4.0]}
    near = resolver.add_obstacle(vq.Box(**wall))
    braking = [resolver.state]
    while resolver.brake() is not None:
        braking.append(resolver.state)
    points = [resolver.setup.arm.points(state.q) for state in braking]
    least = min(resolver.setup.monitor.least(X, among="obstacles")[0] for X in points)
    assert len(braking) > 2
    assert least < problem.clearance.safe
    assert min(near.values()) == pytest.approx(least, abs=2e-3)
    assert all(name.endswith(" / wall") for name in near)


def test_wrong_changes_are_goal_errors_that_change_nothing(tmp_path):
    no_mesh = str(tmp_path / "words.stl")
    (tmp_path / "words.stl").write_text("solid words")
    resolver = vq.Resolver(three_bays(obstacle=[CUBE]))
    ball = vq.Sphere(name="cube", center=[2.0, 0.0, 0.0], radius=0.1)
    wrong = [
        (lambda: resolver.add_obstacle(ball), 'an obstacle "cube" already'),
        (lambda: resolver.add_obstacle(CUBE), "expected Box, Sphere, Cylinder or Mesh"),
        (lambda: resolver.add_obstacle(vq.Mesh(name="m", file=no_mesh)), "holds no triangle|cannot read"),
        (lambda: resolver.move_obstacle("cub", center=[0, 0, 0]), 'did you mean "cube"'),
        (lambda: resolver.move_obstacle("cube", center=[0, 0]), "center"),
        (lambda: resolver.move_obstacle("cube", velocity=[0, np.nan, 0]), "velocity"),
        (lambda: resolver.remove_obstacle("door"), "no obstacle 'door'"),
        (lambda: resolver.set_clearance(safe=-0.1), "safe = -0.1"),
        (lambda: resolver.set_clearance(safe=0.1, self_safe=9.0), "self_safe = 9.0"),
        (lambda: resolver.set_clearance(safe=np.nan), "safe = nan"),
    ]
    before, state = resolver.obstacles, resolver.state
    for call, message in wrong:
        with pytest.raises(vq.GoalError, match=message):
            call()
    assert resolver.obstacles == before
    assert resolver.state is state
    assert resolver.scene_changes == 0
    assert resolver.setup.safe == 0.05


def test_a_moved_obstacle_is_that_made_there(rng, mesh_file):
    resolver = vq.Resolver(three_bays())
    for k in range(8):
        thing = random_obstacle(rng, f"thing {k}", mesh_file)
        resolver.add_obstacle(thing)
        resolver.step(position=resolver.tip()[0], dt=0.25)
        turn = {} if isinstance(thing, vq.Sphere) else {"rotation_vector": rng.normal(size=3)}
        resolver.move_obstacle(thing.name, center=rng.normal(size=3), velocity=rng.normal(size=3), **turn)
        moved, table = resolver.setup.monitor.obstacles[-1], resolver.obstacles[-1]
        made = make_obstacle(table)
        np.testing.assert_allclose(moved.pieces, made.pieces, atol=1e-12)
        np.testing.assert_array_equal(moved.velocity, made.velocity)
        resolver.remove_obstacle(thing.name)
    assert resolver.obstacles == ()


@pytest.mark.parametrize("method", ["pseudoinverse", "curve-pseudoinverse"])
def test_methods_without_rows_take_changes_and_their_records_say_what_they_struck(method):
    problem = with_method(vq.load_problem("five_bay_two_cubes"), method)
    resolver = vq.Resolver(problem)
    tip, recording = resolver.tip()[0], vq.Recording(resolver, problem)
    resolver.step(position=np.add(tip, [0.05, 0.0, 0.0]))
    near = resolver.add_obstacle(vq.Sphere(name="ball", center=np.add(tip, [0.2, 0.0, 0.0]), radius=0.1))
    assert all(name.endswith(" / ball") and distance < 0.08 for name, distance in near.items())
    assert near
    resolver.step(position=np.add(tip, [0.15, 0.0, 0.0]))
    certificate = vq.verify(recording.maneuver())
    assert not certificate.ok
    assert "ball" in certificate.clearance.where


def test_a_serial_arm_keeps_clear_of_what_comes():
    problem = vq.load_problem("snake_past_a_cube")
    resolver = vq.Resolver(problem)
    tip, recording = resolver.tip()[0], vq.Recording(resolver, problem)
    resolver.add_obstacle(vq.Box(name="crate", center=np.add(tip, [0.4, 0.0, 0.1]), size=0.3))
    for k in range(15):
        resolver.step(position=np.add(tip, [0.03 * k, 0.0, 0.0]))
    certificate = vq.verify(recording.maneuver())
    assert certificate.ok, str(certificate)


def test_pictures_show_each_obstacle_while_it_is_there(tmp_path):
    problem = three_bays(obstacle=[CUBE])
    resolver = vq.Resolver(problem)
    tip, recording = resolver.tip()[0], vq.Recording(resolver, problem)
    for k in range(9):
        if k == 3:
            resolver.add_obstacle(vq.Sphere(name="ball", center=[-0.9, 0.0, 2.5], radius=0.2))
        if k == 6:
            resolver.move_obstacle("cube", center=[1.5, 0.0, 2.0])
            resolver.remove_obstacle("ball")
        resolver.step(position=np.add(tip, [0.01 * k, 0.0, 0.0]))
    maneuver = recording.maneuver()
    drawn = drawing_of_maneuver(maneuver).obstacles
    times = {(mesh.name, mesh.since, mesh.until) for mesh in drawn}
    third, sixth = maneuver.time[[3, 6]].tolist()
    assert times == {("cube", -np.inf, sixth), ("ball", third, sixth), ("cube", sixth, np.inf)}
    assert [sum(mesh.is_there(time) for mesh in drawn) for time in maneuver.time[[0, 4, 8]]] == [1, 2, 1]
    assert maneuver.plot(frames=3).axes
    for suffix in ("html", "csv"):
        assert vq.export_maneuver(maneuver, tmp_path / f"loop.{suffix}").is_file()
    with pytest.raises(vq.ExportError, match="this one changed while the arm ran"):
        vq.export_maneuver(maneuver, tmp_path / "loop.xml")


def test_other_threads_may_change_the_scene_while_steps_run():
    problem = three_bays(obstacle=[CUBE])
    resolver = vq.Resolver(problem)
    tip, recording = resolver.tip()[0], vq.Recording(resolver, problem)
    stop, faults = threading.Event(), []

    def disturb():
        random, k = np.random.default_rng(5), 0
        try:
            while not stop.is_set():
                k += 1
                center = [random.uniform(1.2, 1.6), random.uniform(-1.0, 1.0), random.uniform(0.5, 2.5)]
                resolver.add_obstacle(vq.Sphere(name=f"ball {k}", center=center, radius=0.2))
                resolver.move_obstacle("cube", center=[random.uniform(1.3, 1.5), 0.0, 2.0])
                resolver.remove_obstacle(f"ball {k}")
        except Exception as error:
            faults.append(error)

    thread = threading.Thread(target=disturb)
    thread.start()
    try:
        for k in range(60):
            resolver.step(position=tip + 0.15 * np.sin([0.3 * k, 0.2 * k, 0.0]))
    finally:
        stop.set()
        thread.join()
    assert not faults
    assert resolver.scene_changes > 3
    assert vq.verify(recording.maneuver()).ok


def test_one_recording_at_a_time_and_none_of_nothing():
    problem = three_bays()
    resolver = vq.Resolver(problem)
    first = vq.Recording(resolver, problem)
    with pytest.raises(vq.GoalError, match="nothing is recorded yet"):
        first.maneuver()
    resolver.step(position=resolver.tip()[0] + [0.01, 0.0, 0.0])
    second = vq.Recording(resolver, problem)
    resolver.step(position=resolver.tip()[0] + [0.01, 0.0, 0.0])
    assert (len(first), len(second)) == (1, 1)
    second.stop()
    resolver.step(position=resolver.tip()[0] + [0.01, 0.0, 0.0])
    assert len(second) == 1
    assert second.maneuver().time[0] > 0.0
    assert vq.verify(second.maneuver()).ok


def test_a_moving_arm_with_limited_accelerations_still_brakes_after_a_change():
    problem = three_bays(**{"truss.acceleration": 0.3, "truss.rate": 0.4})
    resolver = vq.Resolver(problem)
    tip, recording = resolver.tip()[0], vq.Recording(resolver, problem)
    for _ in range(6):
        resolver.step(position=np.add(tip, [0.5, 0.0, -0.2]), dt=0.1)
    resolver.add_obstacle(vq.Box(name="far wall", center=[2.0, 0.0, 2.0], size=[0.1, 3.0, 3.0]))
    for _ in range(60):
        if resolver.brake() is None:
            break
    assert np.abs(resolver.state.rates).max() < 0.1 * 0.3 + 1e-9
    assert vq.verify(recording.maneuver()).ok
