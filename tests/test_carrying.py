"""What an arm carries at its tip: rows, bounds of its motion, loops with it, and their verification."""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from arms import TRUSSES, random_pose, three_bays
from hypothesis import given
from hypothesis import strategies as st

import vgtm_qp as vq
from vgtm_qp.arm.build import make_arm
from vgtm_qp.arm.carrying import Carried, Carrier, carried
from vgtm_qp.arm.frames import frame_constants, frame_function
from vgtm_qp.arm.truss.arm import TrussArm
from vgtm_qp.arm.truss.bounds import frame_deviation
from vgtm_qp.errors import ResultError
from vgtm_qp.problem.enclosing import box_capsules
from vgtm_qp.result.chain import RecordedChain
from vgtm_qp.rotation import rotation_from_vector
from vgtm_qp.step.build import make_obstacle
from vgtm_qp.verify.arm import RecordedArm, polygon_frame

CRATE = {"name": "crate", "size": [0.3, 0.2, 0.2]}


def arms():
    """Return every arm whose tip has a frame, by name."""
    trusses = {name: TrussArm(make()) for name, make in TRUSSES.items()}
    found = {name: arm for name, arm in trusses.items() if arm.end_effector.has_frame}
    found["offset joints"] = TrussArm(TRUSSES["octahedral"](joint_offset=0.06))
    found["serial"] = make_arm(vq.load_problem("station_arm_past_a_module"))
    return found


ARMS = arms()


def loaded(arm, random, count=2):
    """Return the arm with some capsules at its tip."""
    carrier = Carrier(arm)
    ends = 0.4 * arm.unit * random.normal(size=(count, 2, 3))
    carrier.carry(
        [
            Carried(
                make_obstacle(vq.Sphere(name="load", center=[0, 0, 0], radius=1.0)),
                ends,
                np.full(count, 0.05),
            )
        ]
    )
    return carrier


def random_configuration(arm, random, size=0.05):
    if isinstance(arm, TrussArm):
        return random_pose(arm.truss, random, size)
    q = arm.home_configuration.copy()
    q[:-6] += 10.0 * size * random.normal(size=len(q) - 6)
    return q


def recorded(arm):
    record = json.loads(json.dumps(arm.record()))
    return RecordedArm(record, arm.truss.members) if isinstance(arm, TrussArm) else RecordedChain(record)


@pytest.mark.parametrize("name", ARMS)
def test_the_points_of_what_is_carried_are_fixed_to_the_tip(name, rng):
    arm = ARMS[name]
    carrier, q = loaded(arm, rng), random_configuration(arm, rng)
    kinematics = arm.kinematics(compiled=False)
    kinematics.evaluate(q)
    own = carrier.points(q)[len(arm.points(q)) :] - arm.end_effector.position(arm.nodes(q))
    np.testing.assert_allclose(
        own @ kinematics.tip_rotation, carrier.carried[0].ends.reshape(-1, 3), atol=1e-12
    )


@pytest.mark.parametrize("name", ARMS)
def test_rows_of_what_is_carried_agree_with_finite_differences(name, rng):
    arm = ARMS[name]
    carrier, q = loaded(arm, rng), random_configuration(arm, rng)
    count = len(carrier.points(q))
    points = rng.integers(count, size=(12, 4))
    points[:6, :2] = count - 1 - rng.integers(4, size=(6, 2))
    coefficients = rng.normal(size=(12, 4, 3))
    nodes, by_nodes = carrier.over_nodes(q, points, coefficients)
    # A motion of the configuration, and that of its nodes.
    motion = random_configuration(arm, rng, 1.0) - arm.home_configuration
    h = 1e-6

    def at(s):
        moved = q + s * motion
        return np.einsum("rsc,rsc->r", coefficients, carrier.points(moved)[points]), arm.nodes(moved)

    (ahead, X), (behind, Y) = at(h), at(-h)
    expected = (ahead - behind) / (2 * h)
    found = np.einsum("rsc,rsc->r", by_nodes, ((X - Y) / (2 * h))[nodes])
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


def places(carrier, q):
    """The points of a carrier, with the vertices of hulls in the place of the corners round them."""
    points, bodies = carrier.points(q), carrier.bodies
    hulls = [(hull, own) for hull, own in zip(bodies.hulls, bodies.points, strict=False) if hull is not None]
    corners = np.concatenate([np.zeros(0, dtype=int), *(own for _, own in hulls)])
    vertices = [hull.weights @ points[own] for hull, own in hulls]
    return np.concatenate([*vertices, np.delete(points, corners, axis=0)])


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("size", [0.002, 0.02, 0.06])
def test_bounds_hold_for_every_point_between_two_states(name, size, rng):
    arm = ARMS[name]
    carrier, told = loaded(arm, rng), recorded(arm)
    for _ in range(5):
        start = random_configuration(arm, rng)
        end = start + size * (random_configuration(arm, rng, 1.0) - arm.home_configuration)
        share = np.linspace(0.0, 1.0, 41)
        way = np.stack([places(carrier, (1 - s) * start + s * end) for s in share])
        chord = way[0] + share[:, None, None] * (way[-1] - way[0])
        off = np.linalg.norm(way - chord, axis=2).max(axis=0)
        bound = carrier.deviation(start, end) / 2.0
        assert off.max() <= bound + 1e-12
        mine = slice(way.shape[1] - 4, None)
        reach = np.full(1, np.linalg.norm(carrier.carried[0].ends, axis=2).max())
        bend = told.tip_bend(start, end, reach)[0]
        assert off[mine].max() <= bend / 8.0 + 1e-12
        if size == 0.002 and name != "serial":
            assert bound < 1e-3 * arm.unit
            assert bend / 8.0 < 1e-3 * arm.unit


@pytest.mark.parametrize("corners", [3, 4, 6])
@pytest.mark.parametrize("size", [0.01, 0.1])
def test_bounds_of_frames_of_any_polygon_hold(corners, size, rng):
    """The tip of a truss of the user's own may have any number of nodes, not all in one plane."""
    angle = 2.0 * np.pi * np.arange(corners) / corners
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(corners)], axis=1)
    home = ring + 0.1 * rng.normal(size=ring.shape)
    (cosines,), (sines,), (alignment,) = frame_constants(home[None], np.eye(3)[None])
    frame, bound = frame_function(corners), frame_deviation(corners)
    own = SimpleNamespace(tip=np.arange(corners), _tip_fit=polygon_frame(home, None))
    for _ in range(10):
        start = home + 0.05 * rng.normal(size=home.shape)
        turn = rotation_from_vector(size * rng.normal(size=3))
        end = (start + 0.1 * size * rng.normal(size=home.shape)) @ turn.T + rng.normal(size=3)
        frames = [
            np.array(frame((start + s * (end - start)).T, cosines, sines, alignment)[0])
            for s in np.linspace(0.0, 1.0, 21)
        ]
        direction = rng.normal(size=3)
        way = np.stack(frames) @ (direction / np.linalg.norm(direction))
        off = np.linalg.norm(
            way - way[0] - np.linspace(0.0, 1.0, 21)[:, None] * (way[-1] - way[0]), axis=1
        ).max()
        assert off <= float(bound(start.T, end.T, cosines, sines)) + 1e-12
        assert off <= RecordedArm.tip_bend(own, start, end, np.ones(1))[0] / 8.0 + 1e-12
    assert float(bound(start.T, start.T + 1.0, cosines, sines)) <= 1e-12


@given(st.lists(st.floats(0.01, 2.0), min_size=3, max_size=3), st.integers(0, 2**32 - 1))
def test_capsules_hold_the_box_and_stick_out_little(edges, seed):
    size, random = np.array(edges), np.random.default_rng(seed)
    points = (random.random((400, 3)) - 0.5) * size
    side = random.integers(3, size=400)
    points[np.arange(400), side] = np.sign(points[np.arange(400), side]) * size[side] / 2
    found, least = box_capsules(size), np.full(400, np.inf)
    for ends, radius in found:
        along = ends[1] - ends[0]
        share = np.clip((points - ends[0]) @ along / max(along @ along, 1e-30), 0.0, 1.0)
        least = np.minimum(least, np.linalg.norm(points - ends[0] - share[:, None] * along, axis=1) - radius)
    assert least.max() <= 1e-12
    assert len(found) <= 9
    assert max(np.max(np.abs(ends) + radius - size / 2) for ends, radius in found) <= 0.37 * np.sort(size)[1]


def held_by(body, points):
    """Return how far points (K, 3) are outside the capsules of a body, m."""
    start, along = body.ends[:, 0], body.ends[:, 1] - body.ends[:, 0]
    assert (np.linalg.norm(along, axis=1) > 0.0).all()
    gap = points[:, None] - start
    share = np.clip(np.einsum("kcx,cx->kc", gap, along) / np.einsum("cx,cx->c", along, along), 0.0, 1.0)
    return (np.linalg.norm(gap - share[..., None] * along, axis=2) - body.radius).min(axis=1)


def test_capsules_hold_every_shape(rng, tmp_path):
    file = tmp_path / "stone.stl"
    trimesh.creation.icosahedron().export(file)
    place = {"center": [0.3, -0.2, 0.1], "rotation_vector": [0.4, -0.5, 0.6]}
    turn = rotation_from_vector(place["rotation_vector"])
    shapes = {
        vq.Box(name="b", size=[0.1, 0.2, 0.3], **place): trimesh.creation.box([0.1, 0.2, 0.3]),
        vq.Sphere(name="s", radius=0.2, **place): trimesh.creation.icosphere(radius=0.2),
        vq.Cylinder(name="c", radius=0.1, height=0.4, **place): trimesh.creation.cylinder(0.1, 0.4),
        vq.Mesh(name="m", file=str(file), scale=0.3, **place): trimesh.creation.icosahedron().apply_scale(
            0.3
        ),
    }
    for table, surface in shapes.items():
        points = trimesh.sample.sample_surface(surface, 500, seed=1)[0] @ turn.T + place["center"]
        assert held_by(carried(make_obstacle(table)), points).max() <= 1e-9


def carry_round(problem, crate, shift, steps=30):
    """Return resolver, recording and what was too near after a loop that takes up a crate, and lets it go."""
    resolver = vq.Resolver(problem)
    tip, recording = resolver.tip()[0], vq.Recording(resolver, problem)
    told = []
    for k in range(steps):
        if k == 5:
            told.append(resolver.attach(crate))
        if k == steps - 5:
            told.append(resolver.release(crate.name))
        resolver.step(position=tip + shift * np.sin([0.15 * k, 0.1 * k, 0.05 * k]), dt=0.2)
    return resolver, recording, told


def crate_at(problem, beyond):
    """Return a crate `beyond` the tip of the arm of a problem at home, m."""
    resolver = vq.Resolver(problem)
    position, rotation = resolver.tip()
    return vq.Box(**CRATE, center=position + beyond * rotation[:, 2])


def test_a_loop_that_carries_a_crate_past_obstacles_is_verified(tmp_path):
    problem = three_bays(obstacle=[{"name": "cube", "shape": "box", "center": [0.95, 0.0, 3.2], "size": 0.5}])
    resolver, recording, told = carry_round(problem, crate_at(problem, 0.35), 0.35)
    assert told[0] == {}
    # What was let go is beside the bodies that held it.
    assert all("crate" in name for name in told[1])
    assert [obstacle.name for obstacle in resolver.obstacles] == ["cube", "crate"]
    maneuver = recording.maneuver()
    certificate = vq.verify(maneuver)
    assert certificate.ok, str(certificate)
    scenes = maneuver.manifest["scenes"]
    assert [len(scene.get("carried", ())) for scene in scenes] == [1, 0]
    maneuver.save(tmp_path / "loop.npz")
    assert vq.verify_file(tmp_path / "loop.npz").ok

    def edited(**changes):
        scenes = json.loads(json.dumps(maneuver.manifest["scenes"]))
        scenes[0]["carried"][0].update(changes)
        return replace(maneuver, manifest={**maneuver.manifest, "scenes": scenes})

    large = vq.verify(edited(radius=[0.6] * len(scenes[0]["carried"][0]["radius"])))
    assert not large.ok
    assert "crate" in large.clearance.where + large.self_clearance.where
    count, body = len(scenes[0]["carried"][0]["radius"]), scenes[0]["carried"][0]["body"]
    for wrong in (
        {"ends": [[1.0]]},
        {"radius": ["a"]},
        {"radius": None},
        {"radius": [-0.5] * count},
        {"ends": [], "radius": []},
        {"body": {}},
        {"body": {"name": "crate"}},
        {"body": {**body, "center": [0.0, 0.0]}},
        {"body": {**body, "name": "cube"}},
        {"body": {**body, "name": "B1-1"}},
    ):
        with pytest.raises(ResultError, match=r"manifest\."):
            vq.verify(edited(**wrong))
    for small in ({"radius": [1e-9] * count}, {"body": {**body, "size": [30.0, 20.0, 20.0]}}):
        assert any("sticks out of its capsules" in line for line in vq.verify(edited(**small)).contradictions)


def test_a_crate_keeps_the_arm_from_where_it_could_go_without():
    wall = {"name": "wall", "shape": "box", "center": [0.0, 0.0, 3.15], "size": [3.0, 3.0, 0.2]}
    problem = three_bays(obstacle=[wall])
    crate = crate_at(problem, 0.35)
    reached = {}
    for carries in (False, True):
        resolver = vq.Resolver(problem)
        goal = resolver.tip()[0] + [0.0, 0.0, 0.6]
        if carries:
            resolver.attach(crate)
        for _ in range(40):
            step = resolver.step(position=goal)
        reached[carries] = resolver.tip()[0][2]
        if carries:
            assert any("carried crate / wall" in name for name in step.blocked_by)
            top = resolver.carried[0].center[2] + 0.1
            assert top <= 3.05 - problem.clearance.safe
    assert reached[True] < reached[False] - 0.1


@pytest.mark.parametrize("problem", ["snake_past_a_cube", "offset_joints_past_a_cube", "moving_base"])
def test_other_arms_carry_too(problem):
    problem = vq.load_problem(problem)
    _, recording, _ = carry_round(problem, crate_at(problem, 0.3), 0.05, steps=16)
    certificate = vq.verify(recording.maneuver())
    assert certificate.ok, str(certificate)


def test_a_recording_that_begins_with_a_crate_is_verified():
    problem = three_bays()
    resolver = vq.Resolver(problem)
    resolver.add_obstacle(crate_at(problem, 0.35))
    before = resolver.obstacles[0]
    resolver.attach("crate")
    assert resolver.obstacles == ()
    assert np.allclose(resolver.carried[0].center, before.center, atol=1e-12)
    tip, recording = resolver.tip()[0], vq.Recording(resolver, problem)
    for k in range(6):
        resolver.step(position=tip + np.array([0.02 * k, 0.0, 0.0]))
    maneuver = recording.maneuver()
    assert [scene["row"] for scene in maneuver.manifest["scenes"]] == [0]
    certificate = vq.verify(maneuver)
    assert certificate.ok
    assert any("the scene changed at states 0;" in note for note in certificate.notes)


def test_pairs_that_an_arm_says_touch_are_looked_at_while_it_carries_something_too():
    problem = vq.load_problem("snake_past_a_cube")
    resolver = vq.Resolver(problem)
    resolver.attach(crate_at(problem, 0.3))
    recording = vq.Recording(resolver, problem)
    resolver.step(position=resolver.tip()[0])
    maneuver = recording.maneuver()
    assert vq.verify(maneuver).ok
    forged = {**maneuver.manifest["arm"], "touching": [[0, 6]]}
    certificate = vq.verify(replace(maneuver, manifest={**maneuver.manifest, "arm": forged}))
    assert any("do not touch at home" in line for line in certificate.contradictions)


@pytest.mark.parametrize("first", ["attach", "release", "add"])
def test_a_recording_may_change_before_its_first_step(first):
    wall = {"name": "wall", "shape": "box", "center": [0.0, 0.0, 3.15], "size": [3.0, 3.0, 0.2]}
    problem = three_bays(obstacle=[wall])
    resolver, crate = vq.Resolver(problem), crate_at(problem, 0.35)
    if first == "release":
        resolver.attach(crate)
    tip, recording = resolver.tip()[0], vq.Recording(resolver, problem)
    if first == "attach":
        resolver.attach(crate)
    elif first == "release":
        resolver.release("crate", keep=False)
    else:
        resolver.add_obstacle(vq.Sphere(name="ball", center=[0.8, 0.0, 2.0], radius=0.1))
    for k in range(5):
        resolver.step(position=tip + np.array([0.02 * k, 0.0, 0.0]))
    certificate = vq.verify(recording.maneuver())
    assert certificate.ok, str(certificate)


def test_a_body_that_is_too_near_when_recording_begins_recovers():
    wall = {"name": "wall", "shape": "box", "center": [0.0, 0.0, 3.04], "size": [3.0, 3.0, 0.2]}
    problem = three_bays(obstacle=[wall])
    resolver = vq.Resolver(problem)
    assert resolver.attach(crate_at(problem, 0.35))
    tip, recording = resolver.tip()[0], vq.Recording(resolver, problem)
    for _ in range(8):
        resolver.step(position=tip - np.array([0.0, 0.0, 0.1]))
    certificate = vq.verify(recording.maneuver())
    assert certificate.ok, str(certificate)
    assert any("recovered" in note for note in certificate.notes)


def test_a_body_round_members_of_the_tip_can_be_let_go():
    """Their axes are inside it: the deepest that verification knows is the radius."""
    problem = three_bays()
    resolver, crate = vq.Resolver(problem), crate_at(problem, 0.0)
    tip, recording = resolver.tip()[0], vq.Recording(resolver, problem)
    resolver.step(position=tip)
    resolver.attach(vq.Box(name="crate", center=crate.center, size=[1.0, 1.0, 0.2]))
    resolver.step(position=tip + np.array([0.02, 0.0, 0.0]))
    assert min(resolver.release("crate").values()) < 0.0
    for _ in range(3):
        resolver.step(position=tip + np.array([0.02, 0.0, 0.0]))
    certificate = vq.verify(recording.maneuver())
    assert not any("recovered" in line for line in certificate.contradictions), str(certificate)


def test_a_mesh_stays_what_it_was_when_its_file_goes(tmp_path):
    file = tmp_path / "stone.stl"
    trimesh.creation.icosahedron().export(file)
    problem = three_bays()
    resolver = vq.Resolver(problem)
    tip, rotation = resolver.tip()
    resolver.add_obstacle(vq.Mesh(name="stone", file=str(file), scale=0.1, center=tip + 0.4 * rotation[:, 2]))
    before = resolver.setup.monitor.obstacles[0]
    file.unlink()
    resolver.attach("stone")
    assert np.allclose(resolver.carried[0].center, before.table.center)
    resolver.step(position=tip)
    resolver.release("stone")
    np.testing.assert_allclose(resolver.setup.monitor.obstacles[0].pieces, before.pieces, atol=1e-9)


def test_a_state_of_another_scene_can_be_taken_up_again():
    problem = three_bays(
        obstacle=[{"name": "wall", "shape": "box", "center": [0, 0, 3.04], "size": [3, 3, 0.2]}]
    )
    resolver = vq.Resolver(problem)
    assert resolver.attach(crate_at(problem, 0.35))
    state = resolver.state
    resolver.release("crate", keep=False)
    resolver.remove_obstacle("wall")
    resolver.state = state
    assert not resolver.state.shortfall
    assert resolver.step(position=resolver.tip()[0]).status is vq.StepStatus.REACHED


def test_other_threads_may_read_what_is_carried():
    problem = vq.load_problem("hexapod_past_a_cube")
    states = []
    for reads in (False, True):
        resolver, done = vq.Resolver(problem), threading.Event()
        tip, rotation = resolver.tip()
        resolver.attach(vq.Sphere(name="ball", center=tip + 0.4 * rotation[:, 2], radius=0.1))

        def read(resolver=resolver, done=done):
            while not done.is_set():
                assert resolver.carried[0].name == "ball"

        reader = threading.Thread(target=read)
        if reads:
            reader.start()
        for k in range(25):
            resolver.step(position=tip + np.array([0.01 * k, 0.0, 0.0]))
        done.set()
        if reads:
            reader.join()
        states.append(resolver.state.nodes)
    # Kernels that are compiled meanwhile round in another way.
    np.testing.assert_allclose(*states, rtol=0.0, atol=1e-12)


def test_nearly_round_meshes_are_held_too(tmp_path):
    for stretch in (1.0, 1.0005, 1.002):
        ball = trimesh.creation.icosphere(subdivisions=3, radius=0.2)
        ball.apply_transform(np.diag([stretch, 1.0, 1.0, 1.0]))
        ball.export(tmp_path / "ball.stl")
        table = vq.Mesh(name="ball", file=str(tmp_path / "ball.stl"), center=[0.1, 0.2, 0.3])
        found = carried(make_obstacle(table))
        corners = found.obstacle.pieces[:, :9].reshape(-1, 3)
        assert held_by(found, corners).max() <= 1e-9


def test_what_is_let_go_may_be_gone():
    problem = three_bays()
    resolver = vq.Resolver(problem)
    bodies = len(resolver.setup.monitor.bodies)
    resolver.attach(crate_at(problem, 0.35))
    assert len(resolver.setup.monitor.bodies) > bodies
    assert resolver.release("crate", keep=False) == {}
    assert resolver.obstacles == resolver.carried == ()
    assert len(resolver.setup.monitor.bodies) == bodies


def test_wrong_things_to_carry_are_goal_errors_that_change_nothing(tmp_path):
    (tmp_path / "words.stl").write_text("solid words")
    cube = {"name": "cube", "shape": "box", "center": [1.3, 0.0, 2.0], "size": 0.5}
    resolver = vq.Resolver(three_bays(obstacle=[cube]))
    crate = vq.Box(**CRATE, center=[0.0, 0.0, 4.0])
    resolver.attach(crate)
    wrong = [
        (lambda: resolver.attach(crate), '"crate" is carried already'),
        (lambda: resolver.add_obstacle(crate), '"crate" is carried already'),
        (lambda: resolver.attach("cub"), 'did you mean "cube"'),
        (lambda: resolver.attach(vq.Box(**cube)), 'an obstacle "cube" already'),
        (lambda: resolver.attach(CRATE), "expected Box, Sphere, Cylinder or Mesh"),
        (
            lambda: resolver.attach(vq.Mesh(name="m", file=str(tmp_path / "words.stl"))),
            "no triangle|cannot read",
        ),
        (lambda: resolver.release("cube"), "'cube' is not carried"),
        (lambda: resolver.release(np.zeros(3)), "is not carried"),
        (
            lambda: resolver.attach(vq.Box(**{**CRATE, "name": "B1-1", "center": [0, 0, 4]})),
            "a member of the arm",
        ),
    ]
    before, changes = (resolver.obstacles, resolver.carried), resolver.scene_changes
    for call, message in wrong:
        with pytest.raises(vq.GoalError, match=message):
            call()
    assert (resolver.obstacles, resolver.carried) == before
    assert resolver.scene_changes == changes
    mast = vq.Resolver(vq.load_problem("tetrahedral_truss_circle"))
    if not mast.setup.arm.end_effector.has_frame:
        with pytest.raises(vq.GoalError, match="fewer than three nodes"):
            mast.attach(crate)
