from collections import Counter

import numpy as np
import pytest
from brute_force import brute_force, piece_at, random_clearance
from geometry_reference import octahedral_arm, segment_distance
from hypothesis import given, settings
from hypothesis import strategies as st

from vgtm_qp.geometry.bodies import capsules
from vgtm_qp.geometry.candidates import Candidates
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.geometry.shapes import GeometryError, box, cylinder, mesh, sphere

TETRAHEDRON = ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def random_scene(rng, *, round_numbers=False):
    return random_clearance(
        rng, lambda: 0.3 * rng.normal(size=3), meshes=[TETRAHEDRON], round_numbers=round_numbers
    )


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**31), st.booleans())
def test_near_pairs_and_least_distances_along_a_walk(seed, round_numbers):
    rng = np.random.default_rng(seed)
    X, clearance = random_scene(rng, round_numbers=round_numbers)
    for step in range(5):
        time = 0.1 * step
        expected = brute_force(clearance, X, time)
        near = clearance.near(X, time, self_reach=0.4)
        found = {tuple(near.pair(k)): float(near.distance[k]) for k in reversed(np.argsort(near.distance))}
        meshes = [m for m in expected if not m[2] and clearance.pieces.shape[m[1]] == "triangle"]
        for key, distance in expected.items():
            if key not in meshes and distance < (0.4 if key[2] else 0.5) - 1e-9:
                assert found[key] <= distance + 1e-9
                assert found[key] >= distance - 1e-9 or distance <= -0.029
        # Of a mesh triangle only its second contact may have stayed.
        assert all(distance <= expected[key] + 1e-9 for key, distance in found.items() if key not in meshes)
        for member in range(len(clearance.bodies.points)):
            least = min(expected[key] for key in meshes if key[0] == member)
            if least < 0.5 - 1e-9:
                nearest = min(d for key, d in found.items() if key in meshes and key[0] == member)
                assert nearest <= least + 1e-9
        for among, is_self in (("obstacles", False), ("members", True)):
            least, pair = clearance.least(X, time, among=among)
            reference = min(d for key, d in expected.items() if key[2] == is_self)
            assert pair is not None
            assert least == pytest.approx(max(reference, -0.06 if is_self else -0.03), abs=1e-9)
        to_obstacles, to_members = (clearance.least(X, time, among=a)[0] for a in ("obstacles", "members"))
        assert clearance.least(X, time)[0] == min(to_obstacles, to_members)
        for floor, self_floor in ((0.02, 0.3), (0.3, 0.02), (0.0, 0.0)):
            expected_answer = to_obstacles >= floor and to_members >= self_floor
            assert clearance.keeps(X, time, floor, self_floor) == expected_answer
        X = X + (rng.choice([0.02, 0.2]) if not round_numbers else 0.25) * np.round(
            rng.normal(size=X.shape), 0
        )


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**31))
def test_carried_bounds_never_exceed_the_distance(seed):
    rng = np.random.default_rng(seed)
    X, clearance = random_scene(rng)
    candidates = Candidates(clearance.scene, clearance.influence, clearance.self_influence)
    candidates.cover(X, 0.0, clearance.influence, clearance.self_influence)
    for step in range(4):
        X, time = X + 0.1 * rng.normal(size=X.shape), 0.05 * step
        expected = brute_force(clearance, X, time)
        listed = set()
        motion = candidates.motion(X, time)
        for group in candidates.groups:
            for limit in (0.1, np.inf):
                lower, others = group.lower(motion, limit)
                for k in range(len(group)):
                    key = (int(group.body[k]), int(group.other[k]), group.is_self)
                    listed.add(key)
                    assert (lower[k] if k < len(lower) else others) <= expected[key] + 1e-9
        far, far_self = candidates.beyond(motion)
        for key in expected.keys() - listed:
            assert (far_self if key[2] else far) <= expected[key] + 1e-9
        for group in candidates.groups:
            candidates.count_unneeded(group, 10**6)
        candidates.refresh_where_due(X, time)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.02, 1.5), st.floats(0.0, 0.3))
def test_between_never_certifies_what_sampling_refutes(seed, size, floor):
    rng = np.random.default_rng(seed)
    X, clearance = random_scene(rng)
    end = X + size * rng.normal(size=X.shape)
    report = clearance.along(np.stack([X, end]), 1.0, 1.5, floor)
    s = np.linspace(0.0, 1.0, 60)
    sampled = min(clearance.least(X + f * (end - X), 1.0 + 0.5 * f)[0] for f in s)
    if report.certified:
        assert sampled >= floor - 1e-12
        assert floor - 1e-12 <= report.clearance <= sampled + 1e-12
    else:
        assert len(report.failing) == len(report.fraction) >= 1
        assert ((report.fraction > 0.0) & (report.fraction <= 1.0)).all()
        for k, f in enumerate(report.fraction):
            exact = brute_force(clearance, X + f * (end - X), 1.0 + 0.5 * f)
            assert float(report.failing.distance[k]) <= exact[report.failing.pair(k)] + 1e-9
    if sampled < floor - 1e-9:
        assert not report.certified
        assert report.clearance < floor
        assert report.failing_parameters()


def test_between_certifies_what_is_clear_and_shows_where_it_is_not():
    X = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
    clearance = Clearance(
        capsules([(0, 1)], 0.03), [box("cube", (1.0, 0.0, 1.0), 0.4)], safe=0.08, influence=0.5
    )
    aside, past = X + np.array([0.65, 0.0, 0.0]), X + np.array([2.0, 0.0, 0.0])
    assert clearance.along(np.stack([X, aside]), 0.0, 1.0, 0.0799).certified
    report = clearance.along(np.stack([X, past]), 0.0, 1.0, 0.08)
    assert not report.certified
    assert report.failing.name(0) == "clearance: member 0 / cube"
    assert report.fraction[0] == pytest.approx(0.5, abs=0.1)
    assert report.clearance < 0.0
    fleeing = Clearance(
        capsules([(0, 1)], 0.03),
        [box("cube", (1.0, 0.0, 1.0), 0.4, velocity=(2.0, 0.0, 0.0))],
        safe=0.08,
        influence=0.5,
    )
    assert fleeing.along(np.stack([X, past]), 0.0, 1.0, 0.08).certified
    chasing = Clearance(
        capsules([(0, 1)], 0.03),
        [box("cube", (1.0, 0.0, 1.0), 0.4, velocity=(-3.0, 0.0, 0.0))],
        safe=0.08,
        influence=0.5,
    )
    assert not chasing.along(np.stack([X, X]), 0.0, 1.0, 0.08).certified


@pytest.mark.smoke
def test_a_path_round_an_edge_is_certified_down_to_its_dip():
    clearance = Clearance(
        capsules([(0, 1)], 0.03), [box("cube", (0.0, 0.0, 0.0), 1.0)], safe=0.08, influence=0.5
    )
    axis = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    reach = 0.11
    angle = np.array([0.6, 0.9])
    start, end = (axis + np.array([0.5 + reach * np.cos(a), 0.5 + reach * np.sin(a), 0.0]) for a in angle)
    dip = reach * np.cos(0.15) - 0.03
    assert clearance.along(np.stack([start, end]), 0.0, 0.0, dip - 1e-6).certified
    assert not clearance.along(np.stack([start, end]), 0.0, 0.0, dip + 1e-6).certified


def test_what_is_not_a_number_is_refused():
    X, members = octahedral_arm(2)
    clearance = Clearance(
        capsules(members, 0.03), [sphere("ball", (3.0, 0.0, 1.0), 0.5)], safe=0.08, influence=0.5
    )
    # Of the last the squares overflow, and bounds never meet.
    for value in (np.nan, np.inf, 1e160):
        bad = X.copy()
        bad[4, 1] = value
        for ask in (
            clearance.near,
            clearance.least,
            lambda Y: clearance.along(np.stack([X, Y]), 0.0, 0.0, 0.05),
        ):
            with pytest.raises(GeometryError, match="finite"):
                ask(bad)


@pytest.mark.parametrize("bays", [1, 5])
def test_straight_arm_beside_cubes_on_round_coordinates(bays):
    X, members = octahedral_arm(bays)
    X = np.round(4.0 * X) / 4.0
    cubes = [box("right", (1.25, 0.0, 0.75), 0.5), box("left", (-1.5, 0.25, 1.0), 0.5)]
    clearance = Clearance(capsules(members, 0.03), cubes, safe=0.08, influence=2.0)
    expected = brute_force(clearance, X, 0.0)
    for by_fcl in (True, False):
        near = clearance.near(X, reach=2.0, by_fcl=by_fcl)
        for k in range(len(near)):
            if not near.is_self[k]:
                assert near.distance[k] <= expected[near.pair(k)] + 0.02 * 1.5
        least = {}
        for k in range(len(near)):
            least[near.pair(k)] = min(least.get(near.pair(k), np.inf), float(near.distance[k]))
        for pair, distance in least.items():
            assert distance == pytest.approx(expected[pair], abs=1e-9)
    assert clearance.scene.fcl.asked > 0


def test_parallel_member_has_two_rows():
    X = np.array([[-1.0, 0.0, 0.6], [1.0, 0.0, 0.6]])
    clearance = Clearance(
        capsules([(0, 1)], 0.03), [box("cube", (0.0, 0.0, 0.0), 1.0)], safe=0.08, influence=0.5
    )
    near = clearance.near(X)
    assert sorted(near.weights[:, 1]) == pytest.approx([0.25, 0.75])
    assert near.distance == pytest.approx([0.07, 0.07])
    np.testing.assert_allclose(near.normal, [[0, 0, 1], [0, 0, 1]], atol=1e-12)


def test_rows_predict_the_change_of_distance(rng):
    """Of the two points that a row names; of the pair itself where it has one row and the axis is outside."""
    X, clearance = random_scene(rng)
    near = clearance.near(X, 0.0, reach=1.5, self_reach=1.0)
    step = 1e-6
    change = step * rng.normal(size=X.shape)
    before, after = (brute_force(clearance, X + s * change, s * step) for s in (0.0, 1.0))
    rows = Counter(near.pair(k) for k in range(len(near)))
    compared = 0
    for k in range(len(near)):
        pair = near.pair(k)
        radii = clearance.bodies.radius[near.body[k]]
        if pair.is_self:
            radii += clearance.bodies.radius[near.other[k]]
        if near.distance[k] < 0.01 - radii:
            continue  # An axis inside an obstacle has distance 0 until it is outside again.

        def apart(s, k=k, pair=pair, radii=radii):
            moved = (near.weights[k][:, None] * (X + s * change)[near.points[k]]).reshape(2, 2, 3).sum(axis=1)
            if pair.is_self:
                return np.linalg.norm(moved.sum(axis=0)) - radii
            point = np.concatenate([moved[0], moved[0]])
            obstacle = clearance.pieces.shape[pair.other], piece_at(clearance, pair.other, s * step)
            return segment_distance(str(obstacle[0]), point, obstacle[1]) - radii

        assert apart(0.0) == pytest.approx(near.distance[k], abs=1e-9)
        expected = near.normal[k] @ (near.weights[k] @ change[near.points[k]]) - near.normal_speed[k] * step
        assert apart(1.0) - apart(0.0) == pytest.approx(expected, abs=1e-3 * step)
        # Of contacts alike of a mesh one row stays.
        if rows[pair] == 1 and (pair.is_self or clearance.pieces.shape[pair.other] != "triangle"):
            assert after[pair] - before[pair] == pytest.approx(expected, abs=1e-3 * step)
        compared += 1
    assert compared > 3


def test_far_and_absent_obstacles():
    X, members = octahedral_arm(1)
    far = Clearance(
        capsules(members, 0.03), [sphere("moon", (1000.0, 0.0, 0.0), 1.0)], safe=0.08, influence=0.5
    )
    expected = min(brute_force(far, X, 0.0)[m, 0, False] for m in range(len(members)))
    assert far.least(X, among="obstacles")[0] == pytest.approx(expected, abs=1e-9)
    empty = Clearance(capsules(members, 0.03), safe=0.08, influence=0.5, self_collision=False)
    assert empty.least(X) == (np.inf, None)
    assert len(empty.near(X)) == 0
    report = empty.along(np.stack([X, X + 1.0]), 0.0, 1.0, 0.08)
    assert report.certified
    assert report.clearance == np.inf


def test_names():
    bodies = capsules([(0, 1), (2, 3)], 0.03, ["L3-2", "B1-1"])
    cube = box("right cube", (0.3, 0.0, 0.5), 0.4)
    clearance = Clearance(bodies, [cube], safe=0.08, influence=0.5)
    X = np.array([[0.0, 0, 0], [0, 0, 1], [0.0, 0.2, 0], [0, 0.2, 1]])
    near = clearance.near(X)
    names = {near.name(k) for k in range(len(near))}
    assert names == {
        "clearance: member L3-2 / right cube",
        "clearance: member B1-1 / right cube",
        "clearance: member L3-2 / member B1-1",
    }
    links = capsules([(0, 1), (2, 3)], 0.03, ["1", "2"], kind="link")
    near = Clearance(links, [cube], safe=0.08, influence=0.5).near(X)
    assert "clearance: link 1 / link 2" in [near.name(k) for k in range(len(near))]


def test_neighbours_are_those_with_a_joint_in_common():
    """Of three links with points of their own, the second of which is a neighbour of both others."""
    X = np.array([[0.0, 0, 0], [0, 0, 1], [0.0, 0, 1.1], [0, 1, 1.1], [0.1, 1, 1], [0.1, 0, 0.5]])
    points = [(0, 1), (2, 3), (4, 5)]
    links = capsules(points, 0.03, joints=[(0, 1), (1, 2), (2, 3)], kind="link")
    found = {
        pair: Clearance(b, safe=0.08, influence=2.0).near(X, self_reach=2.0)
        for pair, b in (("joints", links), ("points", capsules(points, 0.03)))
    }
    pairs = {key: {tuple(near.pair(k))[:2] for k in range(len(near))} for key, near in found.items()}
    assert pairs == {"joints": {(0, 2)}, "points": {(0, 1), (0, 2), (1, 2)}}


def test_closed_mesh_equals_the_box_it_bounds_and_is_solid(rng):
    import trimesh

    surface = trimesh.creation.box((1.0, 0.8, 0.6))
    arrays = (surface.vertices, surface.faces)
    solid = Clearance(capsules([(0, 1)], 0.02), [mesh("part", arrays)], safe=0.08, influence=2.0)
    cube = Clearance(
        capsules([(0, 1)], 0.02), [box("part", (0, 0, 0), (1.0, 0.8, 0.6))], safe=0.08, influence=2.0
    )
    outside = 0
    for _ in range(60):
        X = rng.uniform(-1.2, 1.2, size=(2, 3))
        expected = cube.least(X)[0]
        outside += expected > -0.02
        assert solid.least(X)[0] == pytest.approx(expected, abs=1e-12)
    assert outside > 10
    inside = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])
    near = solid.near(inside)
    assert len(near) == 1
    assert near.distance[0] == pytest.approx(-0.2 - 0.02)
    np.testing.assert_allclose(near.normal[0], [1.0, 0.0, 0.0], atol=1e-12)
    assert not solid.along(np.stack([inside, inside + 0.01]), 0.0, 0.0, 0.0).certified


def test_mesh_from_a_file(tmp_path):
    import trimesh

    path = tmp_path / "part.stl"
    trimesh.creation.icosphere(2, 0.5).export(path)
    obstacle = mesh("ball", path, center=(1.0, 0.0, 0.0), scale=2.0)
    assert obstacle.solid
    assert len(obstacle.pieces) == 320
    clearance = Clearance(capsules([(0, 1)], 0.0), [obstacle], safe=0.08, influence=1.0)
    X = np.array([[-0.5, 0.0, -1.0], [-0.5, 0.0, 1.0]])
    assert clearance.least(X)[0] == pytest.approx(0.5, abs=0.02)
    near = clearance.near(X)
    assert 1 <= len(near) < 20


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: box("o", (0, 0, 0), 0.0), "positive"),
        (lambda path: box("o", (0, 0, np.nan), 1.0), "center"),
        (lambda path: box("o", (0, 0, 0), 1.0, 2.0 * np.eye(3)), "rotation"),
        (lambda path: sphere("o", (0, 0, 0), -1.0), "positive"),
        (lambda path: cylinder("o", (0, 0, 0), 1.0, np.inf), "positive"),
        (lambda path: sphere("o", (0, 0, 0), 1.0, (np.inf, 0, 0)), "velocity"),
        (lambda path: mesh("o", path / "none.stl"), "cannot read"),
        (lambda path: mesh("o", path / "part.step"), "not one of"),
        (lambda path: mesh("o", (np.zeros((0, 3)), np.zeros((0, 3), dtype=int))), "no triangle"),
    ],
)
def test_wrong_obstacles(make, message, tmp_path):
    with pytest.raises(GeometryError, match=message):
        make(tmp_path)


def test_long_arm_keeps_few_candidates():
    X, members = octahedral_arm(200)
    clearance = Clearance(
        capsules(members, 0.03), [box("cube", (1.2, 0.0, 80.0), 0.5)], safe=0.08, influence=0.5
    )
    candidates = Candidates(clearance.scene, clearance.influence, clearance.self_influence)
    candidates.cover(X, 0.0, clearance.influence, clearance.self_influence)
    assert sum(map(len, candidates.groups)) < 30 * len(members)
