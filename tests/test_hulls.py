"""Bodies that are convex hulls: distances, rows, proofs over a motion, and whole problems with them."""

import tracemalloc

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import vgtm_qp as vq
from vgtm_qp.geometry import shapes
from vgtm_qp.geometry.bodies import Hull, convex_bodies
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.verify import obstacles as recorded
from vgtm_qp.verify.convex import hull_distance

seeds = st.integers(0, 2**31)
RADII = [0.0, 0.01, 0.0, 0.05]


def turn(rng):
    return Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()


class Scene:
    """Three hulls and a capsule, which move freely, among an obstacle of each shape."""

    def __init__(self, seed, by_fcl=True):
        rng = self.rng = np.random.default_rng(seed)
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
        obstacles = [
            shapes.box("box", (1.0, 0.0, 0.0), (0.3, 0.4, 0.5), self.box),
            shapes.sphere("ball", (0.0, 1.0, 0.0), 0.3),
            shapes.cylinder("post", (0.0, 0.0, 1.5), 0.2, 0.6, self.cylinder),
            shapes.mesh("wedge", (tetrahedron, faces), center=(-1.0, 0.0, 0.0)),
        ]
        self.monitor = Clearance(bodies, obstacles, safe=0.05, influence=10.0)
        if not by_fcl:
            # As if none of FCL's answers were proven.
            self.monitor.scene.fcl = self.monitor.scene.of_hulls = None

    def poses(self):
        return [(turn(self.rng), self.rng.normal(size=3) * 0.8) for _ in self.hulls]

    def points(self, poses):
        ends = np.array([[0.0, 0.0, -0.2], [0.0, 0.0, 0.2]])
        own = [ends if hull is None else hull.simplex for hull in self.hulls]
        return np.vstack([span @ R.T + t for span, (R, t) in zip(own, poses, strict=True)])

    def near(self, X, by_fcl=False):
        return self.monitor.near(X, 0.0, 10.0, self_reach=10.0, by_fcl=by_fcl)

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


def other_distance(scene, X, pair):
    """The distance of a pair by the code of the certificate."""
    vertices, radius = scene.vertices(X, pair.body)[None], RADII[pair.body]
    if pair.is_self:
        others = scene.vertices(X, pair.other)
        found, _ = hull_distance(vertices, lambda n, _: others[(n @ others.T).argmax(axis=1)])
        return found[0] - radius - RADII[pair.other]
    kinds = [
        recorded.Body(
            "", np.array([1.0, 0.0, 0.0]), np.zeros(3), scene.box, recorded.box(np.array([0.15, 0.2, 0.25]))
        ),
        recorded.Body("", np.array([0.0, 1.0, 0.0]), np.zeros(3), np.eye(3), recorded.ball(0.3)),
        recorded.Body(
            "", np.array([0.0, 0.0, 1.5]), np.zeros(3), scene.cylinder, recorded.cylinder(0.2, 0.3)
        ),
    ]
    if pair.other < len(kinds):
        body, pieces = kinds[pair.other], np.zeros(1, dtype=int)
    else:
        triangles = scene.monitor.pieces.parameters[3:, :9].reshape(-1, 3, 3)
        body = recorded.Body("", np.zeros(3), np.zeros(3), np.eye(3), recorded.mesh(triangles, closed=True))
        pieces = np.arange(len(triangles))
    found, _ = body.hull_separation(np.tile(vertices - body.center, (len(pieces), 1, 1)), pieces)
    return found.min() - radius


@pytest.mark.property
@settings(deadline=None, max_examples=15)
@given(seeds)
def test_distances_agree_with_fcl_and_with_the_certificate(seed):
    by_fcl, exact = Scene(seed), Scene(seed, by_fcl=False)
    X = by_fcl.points(by_fcl.poses())
    fcl, contacts = by_fcl.near(X, by_fcl=True), exact.near(X)
    assert fcl.by_fcl.any()
    assert not contacts.by_fcl.any()
    claimed, computed = (least_rows(found, by_obstacle=True) for found in (fcl, contacts))
    assert claimed.keys() == computed.keys()
    for pair, (distance, _) in computed.items():
        assert claimed[pair][0] == pytest.approx(distance, abs=2e-6)
    for pair, (distance, _) in computed.items():
        if pair.body != 3:
            other = other_distance(exact, X, pair)
            if distance + RADII[pair.body] + (RADII[pair.other] if pair.is_self else 0.0) > 1e-6:
                assert other == pytest.approx(distance, abs=1e-9)
            else:
                assert other <= 1e-9
    # The distance of an axis that cuts something is zero, its depth counts only where rows lead out.
    apart = min(computed.values())[0]
    for scene in (by_fcl, exact):
        least = scene.monitor.least(X)[0]
        assert least == pytest.approx(apart, abs=1e-9) if apart > 0.0 else least <= 0.0


@pytest.mark.property
@settings(deadline=None, max_examples=15)
@given(seeds)
def test_rows_agree_with_finite_differences(seed):
    scene = Scene(seed, by_fcl=False)
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
@given(seeds, st.booleans())
def test_what_is_proven_over_a_motion_holds_at_every_instant(seed, by_fcl):
    scene = Scene(seed, by_fcl)
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
@given(seeds)
def test_surfaces_that_overlap_are_parted_along_the_normal(seed):
    scene = Scene(seed)
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


def test_a_plate_that_lies_flat_has_a_contact_at_several_corners():
    scene = Scene(0)
    scene.monitor.put([shapes.box("floor", (0.0, 0.0, -1.0), (4.0, 4.0, 1.0))])
    poses = [(np.eye(3), np.array([0.0, 0.0, z])) for z in (3.0, 6.0, -0.4, 9.0)]
    contacts = scene.near(scene.points(poses), by_fcl=True)
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


def test_distances_from_cylinders_agree_to_the_last_digits():
    rng = np.random.default_rng(3)
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T
    hulls = [Hull.of(corners * rng.uniform(0.05, 0.3, size=3)) for _ in range(200)]
    names = [str(k) for k in range(len(hulls))]
    points = np.arange(4 * len(hulls)).reshape(-1, 4).tolist()
    bodies = convex_bodies(points, hulls, 0.0, names, joints=np.zeros((len(hulls), 2), dtype=int))
    post = shapes.cylinder("post", (0.0, 0.0, 0.0), 0.1, 0.3)
    monitor = Clearance(bodies, [post], safe=0.0, influence=10.0, self_collision=False)
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
