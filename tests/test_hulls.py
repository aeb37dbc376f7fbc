"""Bodies that are convex hulls: distances, rows, proofs over a motion, and whole problems with them."""

import itertools
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import vgtm_qp as vq
from vgtm_qp.compiled import compiler
from vgtm_qp.geometry import shapes
from vgtm_qp.geometry.bodies import Hull, convex_bodies
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.native import building
from vgtm_qp.verify import obstacles as recorded
from vgtm_qp.verify.clearance import AgainstBody, AgainstMembers, Least, RecordedMotion
from vgtm_qp.verify.convex import hull_distance
from vgtm_qp.verify.obstacles import read_obstacles

seeds = st.integers(0, 2**31)
RADII = [0.0, 0.01, 0.0, 0.05]
needs_c = pytest.mark.skipif(compiler() is None, reason="no C compiler")
WAYS = [pytest.param("c", marks=needs_c), "fcl", "squares"]
"""What finds nearest points: C, FCL where there is none, least squares where an answer of FCL is not proven."""


def turn(rng):
    return Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()


class Scene:
    """Three hulls and a capsule, which move freely, among an obstacle of each shape; meshes are not watched."""

    def __init__(self, seed, way, *, meshes=True, fastest=0.0):
        rng = self.rng = np.random.default_rng(seed)
        assert way != "c" or building().finish() is not None
        sizes = [0.1, 0.15, 0.3] * np.ones(3)
        self.hulls = [Hull.of(rng.normal(size=(30, 3)) * sizes) for _ in range(2)]
        corners = np.array(np.meshgrid(*[(-0.2, 0.2)] * 3)).reshape(3, -1).T * [1.0, 0.5, 0.2]
        self.hulls += [Hull.of(corners), None]
        points, names = [range(4), range(4, 8), range(8, 12), range(12, 14)], ["a", "b", "plate", "rod"]
        joints = np.arange(8).reshape(4, 2)
        bodies = convex_bodies([list(own) for own in points], self.hulls, RADII, names, joints=joints)
        tetrahedron = np.array([[0, 0, 0], [0.4, 0, 0], [0, 0.4, 0], [0, 0, 0.4]])
        faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        self.box, self.cylinder = turn(rng), turn(rng)
        self.velocities = fastest * rng.uniform(-1.0, 1.0, size=(3, 3))
        self.obstacles = [
            shapes.box("box", (1.0, 0.0, 0.0), (0.3, 0.4, 0.5), self.box, self.velocities[0]),
            shapes.sphere("ball", (0.0, 1.0, 0.0), 0.3, self.velocities[1]),
            shapes.cylinder("post", (0.0, 0.0, 1.5), 0.2, 0.6, self.cylinder, self.velocities[2]),
        ]
        if meshes:
            self.obstacles += [shapes.mesh("wedge", (tetrahedron, faces), center=(-1.0, 0.0, 0.0))]
        self.monitor = Clearance(bodies, self.obstacles, safe=0.05, influence=10.0, watch=way == "c")
        scene = self.monitor.scene
        if way != "c":
            scene.search = lambda _: None
        if way == "squares":
            scene.fcl = scene.of_hulls = None

    def poses(self):
        return [(turn(self.rng), self.rng.normal(size=3) * 0.8) for _ in self.hulls]

    def points(self, poses):
        ends = np.array([[0.0, 0.0, -0.2], [0.0, 0.0, 0.2]])
        own = [ends if hull is None else hull.simplex for hull in self.hulls]
        return np.vstack([span @ R.T + t for span, (R, t) in zip(own, poses, strict=True)])

    def near(self, X, time=0.0, **how):
        return self.monitor.near(X, time, 10.0, self_reach=10.0, **how)

    def vertices(self, X, body):
        """The vertices of a body whose points are at X."""
        hull, points = self.hulls[body], X[self.monitor.bodies.points[body]]
        return points[:2] if hull is None else hull.weights @ points


def least_rows(contacts, by_obstacle=False):
    """The nearest row of each pair: its distance and number; one of all triangles of a mesh if wanted."""
    found = {}
    for k in range(len(contacts)):
        pair = contacts.pair(k)
        if by_obstacle and not pair.is_self:
            pair = pair._replace(other=contacts.names.owner[pair.other])
        if pair not in found or contacts.distance[k] < found[pair][0]:
            found[pair] = contacts.distance[k], k
    return found


def other_distance(scene, X, pair, time=0.0):
    """The distance of a pair by the code of the certificate."""
    return other_distances(scene, np.array([X]), pair, np.array([time])).min()


def other_distances(scene, states, pair, times):
    """The distances of a pair at states (S, P, 3) and times (S,) by the code of the certificate; of all triangles."""
    vertices = np.array([scene.vertices(X, pair.body) for X in states])
    if pair.is_self:
        others = np.array([scene.vertices(X, pair.other) for X in states])

        def furthest(n, rows):
            return others[rows, np.einsum("pvc,pc->pv", others[rows], n).argmax(axis=1)]

        return hull_distance(vertices, furthest)[0] - RADII[pair.body] - RADII[pair.other]
    kinds = [
        ([1.0, 0.0, 0.0], scene.box, recorded.box(np.array([0.15, 0.2, 0.25]))),
        ([0.0, 1.0, 0.0], np.eye(3), recorded.ball(0.3)),
        ([0.0, 0.0, 1.5], scene.cylinder, recorded.cylinder(0.2, 0.3)),
    ]
    if pair.other < len(kinds):
        center, rotation, shape = kinds[pair.other]
        places = np.array(center) + times[:, None] * scene.velocities[pair.other]
    else:
        triangles = scene.monitor.pieces.parameters[3:, :9].reshape(-1, 3, 3)
        rotation, shape = np.eye(3), recorded.mesh(triangles, closed=True)
        places, vertices = np.zeros((len(triangles), 3)), np.tile(vertices, (len(triangles), 1, 1))
    body = recorded.Body("", np.zeros(3), np.zeros(3), rotation, shape)
    pieces = np.arange(len(vertices)) % len(shape.sizes)
    return body.hull_separation(vertices - places[:, None], pieces)[0] - RADII[pair.body]


@pytest.mark.property
@settings(deadline=None, max_examples=15)
@given(seeds, st.sampled_from(["c", "fcl"] if compiler() else ["fcl"]))
def test_distances_agree_whatever_finds_them_and_with_the_certificate(seed, way):
    other, exact = Scene(seed, way), Scene(seed, "squares")
    X = other.points(other.poses())
    found, contacts = other.near(X, by_fcl=True), exact.near(X)
    of_hulls = found.body != 3
    assert found.by_fcl.any()
    assert found.by_fcl[of_hulls].any() == (way == "fcl")
    assert not contacts.by_fcl.any()
    claimed, computed = (least_rows(rows, by_obstacle=True) for rows in (found, contacts))
    assert claimed.keys() == computed.keys()
    for pair, (distance, _) in computed.items():
        assert claimed[pair][0] == pytest.approx(distance, abs=2e-6 if way == "fcl" else 1e-9)
    for pair, (distance, _) in computed.items():
        if pair.body != 3:
            certified = other_distance(exact, X, pair)
            if distance + RADII[pair.body] + (RADII[pair.other] if pair.is_self else 0.0) > 1e-6:
                assert certified == pytest.approx(distance, abs=1e-9)
            else:
                assert certified <= 1e-9
    # The distance of an axis that cuts something is zero, its depth counts only where rows lead out.
    apart = min(computed.values())[0]
    for scene in (other, exact):
        least = scene.monitor.least(X)[0]
        assert least == pytest.approx(apart, abs=1e-9) if apart > 0.0 else least <= 0.0


@pytest.mark.property
@settings(deadline=None, max_examples=15)
@given(seeds, st.sampled_from(["c", "squares"] if compiler() else ["squares"]))
def test_rows_agree_with_finite_differences(seed, way):
    scene = Scene(seed, way)
    poses, rng = scene.poses(), scene.rng
    moves = [(rng.normal(size=3) * 1e-6, rng.normal(size=3) * 1e-6) for _ in poses]

    def moved(s):
        steps = zip(poses, moves, strict=True)
        return scene.points(
            [(Rotation.from_rotvec(s * w).as_matrix() @ R, t + s * v) for (R, t), (w, v) in steps]
        )

    X, before, after = scene.points(poses), moved(-1.0), moved(1.0)
    contacts = scene.near(X, by_fcl=False)
    found, low, high = (
        least_rows(rows, by_obstacle=True) for rows in (contacts, *(scene.near(at) for at in (before, after)))
    )
    for pair, (distance, k) in found.items():
        # Where surfaces touch, or a triangle is pierced, the normal is another one.
        if distance > 0.02:
            change = (high[pair][0] - low[pair][0]) / 1e-6
            row = contacts.normal[k] @ (contacts.weights[k] @ (after - before)[contacts.points[k]]) / 1e-6
            # The normal of vertices and faces jumps from one to the next; that costs a distance nothing.
            assert change == pytest.approx(row, abs=2e-3)


@pytest.mark.dear
@pytest.mark.property
@settings(deadline=None, max_examples=15)
@given(seeds, st.sampled_from(["c", "fcl", "squares"] if compiler() else ["fcl", "squares"]))
def test_what_is_proven_over_a_motion_holds_at_every_instant(seed, way):
    scene = Scene(seed, way)
    start, end = scene.points(scene.poses()), scene.points(scene.poses())
    end = start + 0.3 * (end - start)
    sampled = min(scene.monitor.least(start + s * (end - start))[0] for s in np.linspace(0.0, 1.0, 51))
    for floor in (sampled - 0.01, sampled + 0.01):
        if floor > 0.0:
            report = scene.monitor.along(np.stack([start, end]), 0.0, 1.0, floor)
            assert report.certified == (floor < sampled)
            if report.certified:
                assert floor <= report.clearance <= sampled + 1e-9
            else:
                assert ((report.fraction > 0.0) & (report.fraction <= 1.0)).all()


@pytest.mark.property
@settings(deadline=None, max_examples=15)
@given(seeds, st.sampled_from(["c", "fcl"] if compiler() else ["fcl"]))
def test_surfaces_that_overlap_are_parted_along_the_normal(seed, way):
    scene = Scene(seed, way)
    poses = scene.poses()
    poses[0] = poses[0][0], np.array([1.0, 0.0, 0.0]) + scene.rng.normal(size=3) * 0.05
    X = scene.points(poses)
    contacts = scene.near(X, by_fcl=True)
    distance, k = next(row for pair, row in least_rows(contacts).items() if pair == (0, 0, False))
    assert distance < 0.0
    out = poses[0][1] - (distance - 1e-3) * contacts.normal[k]
    parted = scene.near(scene.points([(poses[0][0], out), *poses[1:]]))
    assert least_rows(parted)[(0, 0, False)][0] >= 1e-3 - 1e-9


@pytest.mark.property
@settings(deadline=None, max_examples=50)
@given(seeds, st.integers(4, 60))
def test_a_hull_is_in_its_simplex_and_its_faces_look_outwards(seed, count):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-3.0, 1.0, size=3)
    hull = Hull.of(points)
    assert (hull.weights >= 0.0).all()
    np.testing.assert_allclose(hull.weights @ hull.simplex, hull.vertices, atol=1e-9 * hull.size)
    assert {tuple(vertex) for vertex in hull.vertices} <= {tuple(point) for point in points}
    middle = hull.vertices.mean(axis=0)
    a, b, c = np.moveaxis(hull.vertices[hull.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    assert (np.einsum("fc,fc->f", normals, a - middle) > 0.0).all()
    heights = (points - middle) @ hull.normals.T
    assert heights.max(axis=0) == pytest.approx(((hull.vertices - middle) @ hull.normals.T).max(axis=0))
    volume = np.einsum("fc,fc->f", normals, a - middle).sum() / 6.0
    assert volume > 0.0


def test_points_in_a_plane_have_no_hull():
    with pytest.raises(ValueError, match="span a volume"):
        Hull.of([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]])


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("tracked", [False, True])
def test_a_plate_that_lies_flat_has_a_contact_at_several_corners(way, tracked):
    scene = Scene(0, way)
    scene.monitor.put([shapes.box("floor", (0.0, 0.0, -1.0), (4.0, 4.0, 1.0))])
    poses = [(np.eye(3), np.array([0.0, 0.0, z])) for z in (3.0, 6.0, -0.4, 9.0)]
    contacts = scene.near(scene.points(poses), by_fcl=True, tracked=tracked)
    rows = [k for k in range(len(contacts)) if contacts.pair(k) == (2, 0, False)]
    assert len(rows) == 3
    np.testing.assert_allclose(contacts.distance[rows], 0.06, atol=1e-6)
    np.testing.assert_allclose(contacts.normal[rows], np.tile([0.0, 0.0, 1.0], (3, 1)), atol=1e-6)


@pytest.mark.property
@settings(deadline=None, max_examples=20)
@given(seeds)
def test_a_simplex_search_agrees_with_least_squares(seed):
    rng = np.random.default_rng(seed)
    first = rng.normal(size=(20, 40, 3))
    second = rng.normal(size=(20, 40, 3)) + rng.normal(size=(20, 1, 3)) * 6.0
    found, normal = hull_distance(
        first, lambda n, rows: second[rows, np.einsum("pvc,pc->pv", second[rows], n).argmax(axis=1)]
    )
    for a, b, distance, n in zip(first, second, found, normal, strict=True):
        gap = (a @ n).min() - (b @ n).max()
        assert gap == pytest.approx(distance, abs=1e-9)
        if distance > 0.0:
            # No plane leaves a greater gap: the nearest point of the difference is on its face.
            for _ in range(20):
                m = n + rng.normal(size=3) * 10.0 ** rng.uniform(-6.0, 0.0)
                m /= np.linalg.norm(m)
                assert (a @ m).min() - (b @ m).max() <= distance + 1e-9


@pytest.mark.parametrize("way", [WAYS[0], "squares"])
def test_distances_from_cylinders_agree_to_the_last_digits(way):
    rng = np.random.default_rng(3)
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T
    hulls = [Hull.of(corners * rng.uniform(0.05, 0.3, size=3)) for _ in range(200)]
    names = [str(k) for k in range(len(hulls))]
    points = np.arange(4 * len(hulls)).reshape(-1, 4).tolist()
    bodies = convex_bodies(points, hulls, 0.0, names, joints=np.zeros((len(hulls), 2), dtype=int))
    post = shapes.cylinder("post", (0.0, 0.0, 0.0), 0.1, 0.3)
    monitor = Clearance(bodies, [post], safe=0.0, influence=10.0, self_collision=False)
    if way != "c":
        monitor.scene.search = lambda _: None
    monitor.scene.of_hulls = None
    poses = [(turn(rng), rng.normal(size=3) * 0.25) for _ in hulls]
    X = np.vstack([hull.simplex @ R.T + t for hull, (R, t) in zip(hulls, poses, strict=True)])
    contacts = monitor.near(X, 0.0, 10.0)
    vertices = np.array([hull.weights @ X[own] for hull, own in zip(hulls, points, strict=True)])
    shape = recorded.cylinder(0.1, 0.15)
    found, _ = shape.hull_distance(vertices, np.tile(shape.sizes, (len(hulls), 1)))
    least = {pair.body: distance for pair, (distance, _) in least_rows(contacts).items()}
    apart = [body for body, distance in least.items() if distance > 1e-6]
    assert len(apart) > 100
    np.testing.assert_allclose(found[apart], [least[body] for body in apart], rtol=0.0, atol=5e-12)


def test_a_hull_inside_a_closed_mesh_is_not_clear_even_where_touching_is(tmp_path):
    corners = np.array(np.meshgrid([-0.05, 0.05], [-0.05, 0.05], [0.1, 0.2])).reshape(3, -1).T
    joints = [
        {"name": f"j{k}", "axis": axis, "position": [0.0, 0.0, 0.3 if k else 0.0], "home": 0.4}
        for k, axis in enumerate([[0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]])
    ]
    data = {
        "schema_version": 1,
        "arm": {
            "joint": joints,
            "tip": [0.0, 0.0, 0.3],
            "body": [{"name": "block", "joint": "j2", "points": corners.tolist()}],
        },
        "maneuver": {"steps": 1, "waypoint": [{"time": 1.0, "position": [0.5, -0.4, 0.9]}]},
        "clearance": {"safe": 0.0},
        "method": {"tracking": "none"},
    }
    maneuver = vq.solve(vq.Problem.from_dict(data))
    assert maneuver.certificate.ok
    file = tmp_path / "shell.stl"
    trimesh.creation.box((2.0, 2.0, 2.0)).export(file)
    shell = {"name": "shell", "shape": "mesh", "file": str(file), "center": [0.0, 0.0, 0.5]}
    certificate = vq.verify(maneuver, problem=vq.Problem.from_dict(data | {"obstacle": [shell]}))
    assert not certificate.clearance.ok
    assert certificate.clearance.value <= -0.1 * np.sqrt(3.0)
    # A solid that the hull reaches into is seen too, however deep it is in it.
    for size in (0.3, 2.0):
        solid = {"name": "solid", "shape": "box", "size": size, "center": [0.1, 0.0, 0.8]}
        certificate = vq.verify(maneuver, problem=vq.Problem.from_dict(data | {"obstacle": [solid]}))
        for measure in (certificate.clearance, certificate.clearance_between):
            assert not measure.ok
            assert -2.0 * size < measure.value < 0.0


def test_many_vertices_and_many_triangles_are_taken_by_parts(rng):
    ways = rng.normal(size=(3000, 3))
    ball = Hull.of(0.3 * ways / np.linalg.norm(ways, axis=1)[:, None])
    cube = Hull.of(np.array(np.meshgrid(*[(-0.1, 0.1)] * 3)).reshape(3, -1).T)
    bodies = convex_bodies(
        [range(4), range(4, 8)], [ball, cube], 0.0, ["ball", "cube"], joints=[[0, 1], [1, 2]]
    )
    rock = trimesh.creation.icosphere(2, 0.2)
    obstacle = shapes.mesh("rock", (rock.vertices, rock.faces), center=(1.0, 0.0, 0.0))
    away, center = np.array([0.5, 0.6, 0.0]), np.array([1.0, 0.0, 0.0])
    X = np.vstack([ball.simplex, cube.simplex + away])
    monitor = Clearance(bodies, [obstacle], safe=0.0, influence=5.0, self_collision=False)
    # More vertices than are in the memory at a time.
    assert len(ball.vertices) * len(monitor.pieces) > 500_000
    contacts = monitor.near(X, 0.0, 5.0)
    shape, found = recorded.mesh(rock.triangles + center, closed=True), {}
    for k in range(len(contacts)):
        pair = contacts.pair(k)
        found.setdefault((pair.body, pair.other), contacts.distance[k])
    for body, vertices in enumerate((ball.vertices, cube.vertices + away)):
        pieces = [piece for own, piece in found if own == body]
        assert pieces
        expected, _ = shape.hull_distance(np.tile(vertices, (len(pieces), 1, 1)), shape.sizes[pieces])
        got = [found[body, piece] for piece in pieces]
        np.testing.assert_allclose(got, expected, rtol=0.0, atol=2e-6)


def test_a_long_trajectory_of_a_fine_hull_is_certified_in_little_memory(rng):
    ways = rng.normal(size=(3000, 3))
    ball = 0.1 * ways / np.linalg.norm(ways, axis=1)[:, None] + [0.5, 0.0, 0.0]
    data = {
        "schema_version": 1,
        "arm": {
            "joint": [{"name": "hip", "axis": [0, 0, 1]}, {"name": "knee", "axis": [0, 1, 0]}],
            "tip": [1.0, 0.0, 0.0],
            "body": [{"name": "ball", "joint": "hip", "points": ball.tolist()}],
        },
        "obstacle": [{"name": "post", "shape": "sphere", "center": [0.5, 0.0, 0.4], "radius": 0.2}],
        "maneuver": {"waypoint": [{"time": 1.0, "position": [0.9, 0.1, 0.0]}]},
        "clearance": {"safe": 0.02},
    }
    certifier, times = vq.Certifier(vq.Problem.from_dict(data)), np.linspace(0.0, 1.0, 2000)
    tracemalloc.start()
    verdict = certifier.certify(times, np.stack([np.sin(times), 0.0 * times], axis=1))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert verdict.certified
    assert 0.09 < verdict.clearance < 0.11
    # The places of all vertices at all rows are 144 MB, and those of all pairs 288 MB.
    assert peak < 280e6


def walk(scene, count, size):
    """Points at poses that wander, from one where nothing overlaps on, each with its time."""
    poses, time = scene.poses(), 0.0
    while scene.monitor.least(scene.points(poses))[0] < 0.05:
        poses = scene.poses()
    for _ in range(count):
        yield scene.points(poses), time
        moves = scene.rng.normal(size=(len(poses), 2, 3)) * size
        poses = [
            (Rotation.from_rotvec(w).as_matrix() @ R, t + v)
            for (R, t), (w, v) in zip(poses, moves, strict=True)
        ]
        time += 0.1


@needs_c
@pytest.mark.property
@settings(deadline=None, max_examples=10)
@given(seeds, st.sampled_from([0.0, 0.3]))
def test_the_watch_has_the_rows_of_the_lists(seed, fastest):
    watched, listed = (Scene(seed, way, meshes=False, fastest=fastest) for way in ("c", "squares"))
    for X, time in walk(watched, 10, 0.05):
        if listed.monitor.least(X, time)[0] < 1e-3:
            break
        found, wanted = (scene.near(X, time, tracked=True) for scene in (watched, listed))
        assert watched.monitor.watching() is not None
        least, expected = least_rows(found), least_rows(wanted)
        assert least.keys() == expected.keys()
        for pair, (distance, k) in expected.items():
            own = least[pair][1]
            assert least[pair][0] == pytest.approx(distance, abs=1e-9)
            if pair.body != 3 and not (pair.is_self and pair.other == 3):
                # Of least squares a normal at a rim has half of the digits.
                np.testing.assert_allclose(found.normal[own], wanted.normal[k], atol=1e-5)
            weights = found.weights[own].reshape(2, 4) * [[1.0], [-1.0]]
            assert weights.min() >= -1e-9
            np.testing.assert_allclose(weights.sum(axis=1), [1.0, float(pair.is_self)], atol=1e-9)
            if pair.body != 3:
                assert other_distance(watched, X, pair, time) == pytest.approx(distance, abs=1e-9)
        alone = [
            np.unique([rows.pair(k) for k in range(len(rows))], axis=0, return_counts=True)
            for rows in (found, wanted)
        ]
        np.testing.assert_array_equal(alone[0][1], alone[1][1])


@needs_c
@pytest.mark.property
@settings(deadline=None, max_examples=15)
@given(seeds, st.sampled_from([0.0, 0.5]))
def test_what_the_watch_proves_of_hulls_holds_at_every_instant(seed, fastest):
    scene = Scene(seed, "c", meshes=False, fastest=fastest)
    watch, shares = scene.monitor.watching(), np.linspace(0.0, 1.0, 51)
    for (start, since), (end, until) in itertools.pairwise(walk(scene, 8, 0.15)):
        contacts = scene.near(start, since, tracked=True)
        if not contacts.distance.min() > 0.0:
            break
        pairs = {contacts.pair(k) for k in range(len(contacts)) if contacts.body[k] != 3}
        way, times = start + shares[:, None, None] * (end - start), since + shares * (until - since)
        sampled = min(other_distances(scene, way, pair, times).min() for pair in pairs)
        # A tenth of the way is so short that the motion alone bounds the distance.
        nearer = 0.1 * (2.0 * np.linalg.norm(end - start, axis=1).max() + fastest * (until - since) * 2.0)
        certain = contacts.distance.min() - nearer
        if certain > 0.0:
            here, then = start + 0.1 * (end - start), since + 0.1 * (until - since)
            assert watch.follow(np.stack([start, here]), since, then, certain, certain)
        for floor in (0.9 * sampled, sampled + 1e-3) if sampled > 0.0 else ():
            is_proven = watch.follow(np.stack([start, end]), since, until, floor, floor)
            assert not (is_proven and floor > sampled)


@needs_c
def test_of_many_hulls_those_that_come_near_are_seen(rng):
    """More pairs than are all listed."""
    assert building().finish() is not None
    corners = np.array(np.meshgrid(*[(-0.1, 0.1)] * 3)).reshape(3, -1).T
    hulls = [Hull.of(corners * rng.uniform(0.3, 1.0, size=3)) for _ in range(60)]
    points = np.arange(4 * len(hulls)).reshape(-1, 4)
    bodies = convex_bodies(points.tolist(), hulls, 0.005, list(map(str, points[:, 0])), joints=points[:, :2])
    grid = np.array(np.meshgrid(*[np.arange(5.0)] * 3)).reshape(3, -1).T
    balls = [shapes.sphere(f"ball {k}", 0.6 * grid[k] + 0.3, 0.05) for k in range(40)]
    options = {"safe": 0.01, "influence": 0.15}
    watched, listed = (Clearance(bodies, balls, watch=watch, **options) for watch in (True, False))
    poses, compared = [(turn(rng), 0.6 * middle) for middle in grid[: len(hulls)]], 0
    for _ in range(12):
        X = np.concatenate([hull.simplex @ R.T + t for hull, (R, t) in zip(hulls, poses, strict=True)])
        moves = 0.05 * rng.normal(size=(len(poses), 2, 3))
        poses = [
            (Rotation.from_rotvec(w).as_matrix() @ R, t + v)
            for (R, t), (w, v) in zip(poses, moves, strict=True)
        ]
        found, wanted = (
            least_rows(one.near(X, 0.0, 0.3, self_reach=0.3, tracked=True)) for one in (watched, listed)
        )
        wanted = {pair: row for pair, row in wanted.items() if row[0] > 1e-6}
        assert wanted.keys() <= found.keys()
        for pair, (distance, _) in wanted.items():
            assert found[pair][0] == pytest.approx(distance, abs=1e-9)
        compared += len(wanted)
    assert watched.watching() is not None
    assert compared > 100


@needs_c
def test_a_normal_at_a_rim_is_the_same_whatever_it_was_before(rng):
    scene = Scene(0, "c", meshes=False)
    scene.monitor.put([shapes.cylinder("post", (0.0, 0.0, 1.5), 0.2, 0.6, scene.cylinder)])
    compared = 0
    for _ in range(20):
        poses = scene.poses()
        X = scene.points(poses)
        if scene.monitor.least(X)[0] < 0.01:
            continue
        first = scene.near(X, tracked=True)
        scene.near(X + rng.normal(size=3) * 0.5, tracked=True)
        again = scene.near(X, tracked=True)
        own = np.flatnonzero(~first.is_self & (first.body != 3))
        np.testing.assert_allclose(first.normal[own], again.normal[own], rtol=0.0, atol=1e-11)
        compared += len(own)
    assert compared > 10


@needs_c
@pytest.mark.property
@settings(deadline=None, max_examples=20)
@given(seeds)
def test_the_search_says_which_pairs_overlap(seed):
    assert building().finish() is not None
    rng = np.random.default_rng(seed)
    hulls = [Hull.of(rng.normal(size=(12, 3))) for _ in range(2)]
    bodies = convex_bodies([range(4), range(4, 8)], hulls, 0.0, ["a", "b"], joints=[[0, 1], [2, 3]])
    search = Clearance(bodies, safe=0.0, influence=1.0).scene.search("segment")
    shift = rng.normal(size=(40, 3)) * 2.0
    first = np.array([hulls[0].simplex @ turn(rng).T for _ in shift])
    second = np.array([hulls[1].simplex @ turn(rng).T + t for t in shift])
    numbers = np.concatenate([first, second], axis=1).reshape(len(shift), -1)
    every = np.zeros(len(shift), dtype=int)
    x, y, normal, is_apart = search(every, every + 1, numbers)
    own, others = hulls[0].weights @ first, hulls[1].weights @ second
    exact, _ = hull_distance(
        own, lambda n, rows: others[rows, np.einsum("pvc,pc->pv", others[rows], n).argmax(axis=1)]
    )
    np.testing.assert_array_equal(is_apart, exact > 1e-9)
    gap = np.einsum("pvc,pc->pv", own, normal).min(axis=1) - np.einsum("pvc,pc->pv", others, normal).max(
        axis=1
    )
    np.testing.assert_allclose(gap[is_apart], exact[is_apart], rtol=0.0, atol=1e-10)
    np.testing.assert_allclose((x - y)[is_apart], (gap[:, None] * normal)[is_apart], atol=1e-6)


@pytest.mark.property
@settings(deadline=None, max_examples=20)
@given(seeds)
def test_a_search_that_ends_early_has_a_lower_bound_that_is_enough(seed):
    rng = np.random.default_rng(seed)
    own = rng.normal(size=(40, 15, 3))
    others = rng.normal(size=(40, 15, 3)) + rng.normal(size=(40, 1, 3)) * 4.0

    def furthest(n, rows):
        return others[rows, np.einsum("pvc,pc->pv", others[rows], n).argmax(axis=1)]

    exact, _ = hull_distance(own, furthest)
    enough = np.maximum(exact, 0.0) + rng.normal(size=40)
    near = rng.normal(size=(40, 3))
    near /= np.linalg.norm(near, axis=1)[:, None]
    for hint in (None, near):
        bound, normal = hull_distance(own, furthest, hint, enough)
        short, apart = exact < enough, exact > 0.0
        np.testing.assert_allclose(bound[short & apart], exact[short & apart], rtol=0.0, atol=1e-9)
        assert (bound[~short] >= enough[~short]).all()
        assert (bound[~apart] <= 0.0).all()
        for found, along in ((bound, normal), hull_distance(own, furthest, hint, enough, decides=True)):
            gap = np.einsum("pvc,pc->pv", own, along).min(axis=1)
            gap -= np.einsum("pvc,pc->pv", others, along).max(axis=1)
            np.testing.assert_allclose(found[apart], gap[apart], rtol=0.0, atol=1e-12)
            assert (found[apart] <= exact[apart] + 1e-12).all()
            np.testing.assert_array_equal((found >= enough)[apart], ~short[apart])


def hulled_arm(rng):
    """An arm of four joints with hulls round its links, and obstacles of three shapes, one of which moves."""
    joints = [
        {"name": f"j{k}", "axis": axis, "position": [0.0, 0.0, 0.4 if k else 0.0]}
        for k, axis in enumerate([[0, 0, 1], [0, 1, 0], [1, 0, 0], [0, 1, 0]])
    ]
    ends = np.repeat([[0.0, 0.0, 0.1], [0.0, 0.0, 0.3]], 8, axis=0)
    hulls = [ends + 0.05 * rng.normal(size=ends.shape) for _ in joints]
    bodies = [
        {"name": f"b{k}", "joint": joint["name"], "points": points.tolist(), "radius": 0.01 * (k % 2)}
        for k, (joint, points) in enumerate(zip(joints, hulls, strict=True))
    ]
    turn = rng.normal(size=3).tolist()
    obstacles = [
        {
            "name": "box",
            "shape": "box",
            "size": [0.2, 0.3, 0.1],
            "center": [0.8, 0.0, 0.9],
            "rotation_vector": turn,
        },
        {
            "name": "ball",
            "shape": "sphere",
            "radius": 0.2,
            "center": [-0.7, 0.5, 1.0],
            "velocity": [0.02, 0.0, 0.0],
        },
        {"name": "post", "shape": "cylinder", "radius": 0.1, "height": 0.5, "center": [0.0, -0.9, 1.1]},
    ]
    return vq.Problem.from_dict(
        {
            "schema_version": 1,
            "arm": {"joint": joints, "tip": [0.0, 0.0, 0.4], "body": bodies},
            "maneuver": {"waypoint": [{"time": 1.0, "position": [0.9, 0.1, 0.5]}]},
            "obstacle": obstacles,
        }
    )


@pytest.mark.property
@settings(deadline=None, max_examples=8)
@given(seeds)
def test_bounds_of_the_certificate_hold_at_every_instant_and_are_close(seed):
    rng = np.random.default_rng(seed)
    problem = hulled_arm(rng)
    arm, (bodies, _, _) = vq.Certifier(problem).arm, read_obstacles(problem.to_dict(), None, Path())
    # Some steps are so long that the arm comes near on the way and is far at both ends, some fold it past itself.
    states = rng.normal(scale=rng.choice([0.3, 1.5]), size=(5, 10)) * (np.arange(10) < 4)
    if rng.random() < 0.5:
        states[:, 2:4] = [[0.8, 2.3], [-0.8, 2.3]] * 2 + [[0.8, 2.3]] + 0.2 * rng.normal(size=(5, 2))
    motion = RecordedMotion(arm, np.arange(5.0), states)
    count, dense = len(arm.radius), np.linspace(0.0, 4.0, 201)
    step = np.minimum(dense.astype(int), 3)
    every = (np.tile(np.arange(count), len(dense)), np.zeros(count * len(dense), dtype=int))
    own = np.triu_indices(count, 2)
    apart = tuple(np.tile(side, len(dense)) for side in own)
    for group in (*(AgainstBody(motion, body) for body in bodies), AgainstMembers(motion)):
        pair = apart if isinstance(group, AgainstMembers) else every
        at = np.repeat(step, len(pair[0]) // len(dense)), np.repeat(dense - step, len(pair[0]) // len(dense))
        points = group.points(
            pair, lambda body, at=at: motion.ends_between(at[0], body, at[1]), at[0] + at[1]
        )
        sampled = group.separation(points, pair)[0].reshape(len(dense), -1).min(axis=1)
        least = group.at_states()
        np.testing.assert_allclose([one.value for one in least], sampled[::50], rtol=0.0, atol=1e-9)
        limit, bound = group.between(min(least, key=lambda one: one.value), Least())
        # Of bodies that overlap only that is known.
        assert min(bound.value, limit.value) <= max(sampled.min(), 0.0) + 1e-12
        if sampled.min() > 0.01:
            assert limit.value <= sampled.min() + motion.resolution
            assert bound.value >= limit.value - motion.resolution - 1e-12
