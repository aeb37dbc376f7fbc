from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from arms import TRUSSES
from brute_force import MEMBERS, brute_force, every_pair, random_clearance

from vgtm_qp.arm.truss.arm import TrussArm
from vgtm_qp.compiled import Kernel, compiler
from vgtm_qp.geometry.bodies import capsules
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.geometry.pairs import Pair
from vgtm_qp.geometry.shapes import GeometryError, box, mesh, sphere
from vgtm_qp.geometry.watch import Watch
from vgtm_qp.native import Code, Program, building

FORWARD = np.array([1.0, 0.0, 0.0])


def scene(rng, *, fastest=0.0, round_numbers=False):
    """Nodes, and a monitor of their members among a box, a ball and a post, whose speeds are up to `fastest`."""

    def velocity():
        way = rng.normal(size=3)
        return rng.uniform(0.0, fastest) * way / np.linalg.norm(way) if fastest else np.zeros(3)

    return random_clearance(rng, velocity, round_numbers=round_numbers)


def watch_of(monitor):
    """A watch of its own, also for scenes that their monitor does not watch."""
    return Watch(monitor.scene, monitor.influence, monitor.self_influence)


def walk(X, rng, count, size):
    """Node positions of a walk, one array for each state."""
    states = [X]
    for _ in range(count):
        drift = rng.normal(size=3) * size
        states.append(states[-1] + drift + rng.normal(size=X.shape) * 0.3 * size)
    return states


def nearest_by_name(found):
    """Least distance of each pair, m, by its name."""
    nearest = {}
    for k, distance in enumerate(found.distance):
        nearest[found.name(k)] = min(nearest.get(found.name(k), np.inf), distance)
    return nearest


@pytest.mark.parametrize(("round_numbers", "fastest"), [(False, 0.0), (True, 0.0), (False, 0.4), (True, 0.4)])
def test_every_pair_nearer_than_the_limits_is_there_in_every_state(round_numbers, fastest, rng):
    compared = 0
    for _ in range(8):
        X, monitor = scene(rng, round_numbers=round_numbers, fastest=fastest)
        watch, time = watch_of(monitor), rng.uniform(-3.0, 3.0)
        for state in walk(X, rng, 25, 0.06):
            time += rng.uniform(-0.1, 0.3)
            limits = {False: rng.uniform(0.2, 0.5), True: rng.uniform(0.1, 0.3)}
            every = brute_force(monitor, state, time).items()
            wanted = {
                monitor.names.clearance(Pair(*pair)): distance
                for pair, distance in every
                if distance < limits[pair[2]]
            }
            found = watch.near(state, time, limits[False], limits[True])
            if found is None:
                assert min(wanted.values()) <= 0.0
                continue
            assert nearest_by_name(found) == pytest.approx(wanted, abs=1e-9)
            compared += len(wanted)
            along = np.einsum("rs,rsc,rc->r", found.weights, state[found.points], found.normal)
            np.testing.assert_allclose(along[found.is_self], found.distance[found.is_self] + 0.06, atol=1e-9)
    assert compared >= 20


@pytest.mark.parametrize("fastest", [0.0, 0.3])
def test_what_is_proven_on_the_way_holds_at_every_instant(fastest, rng):
    proven = 0
    for _ in range(10):
        X, monitor = scene(rng, fastest=fastest)
        watch, since = watch_of(monitor), rng.uniform(-2.0, 2.0)
        for start, end in pairwise(walk(X, rng, 12, 0.05)):
            until = since + rng.uniform(0.0, 0.4)
            here = brute_force(monitor, start, since).items()
            floors = [
                max(0.0, 0.9 * min(distance for pair, distance in here if pair[2] is is_self))
                for is_self in (False, True)
            ]
            watch.near(start, since, floors[0] + 0.2, floors[1] + 0.2)
            middle = start + 0.5 * (end - start)
            is_proven = watch.follow(np.stack([start, middle, end]), since, until, *floors)
            for s in np.linspace(0.0, 1.0, 11) if is_proven else ():
                at, time = start + s * (end - start), since + s * (until - since)
                for pair, distance in brute_force(monitor, at, time).items():
                    assert distance >= floors[pair[2]] - 1e-12
            proven, since = proven + is_proven, until
    assert proven >= 5


def test_an_obstacle_that_comes_through_a_body_at_rest_is_not_proven():
    ball = sphere("ball", [1.0, 0.0, 0.5], 0.1, [-1.0, 0.0, 0.0])
    monitor = Clearance(capsules([(0, 1), (2, 3)], 0.03), [ball], safe=0.08, influence=0.5)
    X = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 9.0, 0.0], [0.0, 9.0, 1.0]])
    watch = watch_of(monitor)
    assert watch.follow(np.stack([X, X]), 0.0, 0.7, 0.08, 0.0)
    assert watch.keeps(X, 0.7, 0.08, 0.0)
    # What holds at one time says nothing of another.
    assert not watch.keeps(X, 0.9, 0.08, 0.0)
    assert not watch.follow(np.stack([X, X]), 0.0, 0.9, 0.08, 0.0)
    # Before and after all is clear.
    assert not watch.follow(np.stack([X, X]), 0.0, 2.0, 0.08, 0.0)
    assert watch.follow(np.stack([X, X - 2.0 * FORWARD]), 0.0, 2.0, 0.08, 0.0)
    assert watch.follow(np.stack([X, X]), 2.0, 3.0, 0.08, 0.0)


@pytest.mark.smoke
def test_a_way_into_an_obstacle_is_not_proven():
    wall = box("wall", [1.0, 0.0, 0.0], [0.1, 4.0, 4.0])
    monitor = Clearance(capsules([(0, 1)], 0.03), [wall], safe=0.08, influence=0.5, self_collision=False)
    start = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    watch = watch_of(monitor)
    assert watch.follow(np.stack([start, start + 0.1 * FORWARD]), 0.0, 0.0, 0.08, 0.0)
    assert not watch.follow(np.stack([start, start + 0.9 * FORWARD]), 0.0, 0.0, 0.08, 0.0)
    # Through the wall to where all is clear again: only the way tells.
    assert not watch.follow(np.stack([start, start + 2.0 * FORWARD]), 0.0, 0.0, 0.08, 0.0)
    assert watch.follow(np.stack([start, start - 0.5 * FORWARD]), 0.0, 0.0, 0.08, 0.0)
    for number in (np.nan, np.inf):
        with pytest.raises(GeometryError, match="finite"):
            watch.follow(np.stack([start, np.full((2, 3), number)]), 0.0, 0.0, 0.08, 0.0)
    assert watch.follow(np.stack([start, start + 0.1 * FORWARD]), 0.0, 0.0, 0.08, 0.0)
    assert not watch.follow(np.stack([start, start + 0.9 * FORWARD]), 0.0, 0.0, 0.08, 0.0)


@pytest.mark.parametrize("fastest", [0.0, 0.5])
def test_a_way_from_a_state_that_was_left_is_bound_from_there(fastest, rng):
    X, monitor = scene(rng, fastest=fastest)
    watch, fresh = watch_of(monitor), watch_of(monitor)
    states = walk(X, rng, 10, 0.1)
    for k, state in enumerate(states):
        watch.near(state, 0.1 * k, 0.4, 0.3)
    for k, state in enumerate(states):
        found, wanted = watch.near(state, 0.1 * k, 0.4, 0.3), fresh.near(state, 0.1 * k, 0.4, 0.3)
        assert (found is None) == (wanted is None)
        if found is not None:
            np.testing.assert_allclose(np.sort(found.distance), np.sort(wanted.distance), atol=1e-12)


def test_scenes_that_are_watched():
    def watched(*obstacles, members=MEMBERS, **options):
        monitor = Clearance(capsules(members, 0.03), obstacles, safe=0.08, influence=0.5, **options)
        return monitor.is_watched

    ball = sphere("ball", [5.0, 0.0, 0.0], 0.2)
    wedge = mesh(
        "wedge", ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    )
    assert watched(ball)
    assert watched()
    assert not watched(wedge)
    assert watched(sphere("ball", [5.0, 0.0, 0.0], 0.2, [0.1, 0.0, 0.0]))
    assert not watched(self_collision=False)
    assert watched(members=[(k, k + 1) for k in range(400)])


def compare(first, second, X, **reach):
    """Compare the contacts that two monitors find; return how many they are."""
    found = [monitor.near(X, **reach, tracked=True) for monitor in (first, second)]
    orders = [np.lexsort((c.weights[:, 1], c.other, c.body, c.is_self)) for c in found]
    names = [[c.name(k) for k in range(len(c))] for c in found]
    assert names[0] == names[1]
    for column in ("distance", "normal", "points", "weights", "normal_speed", "by_fcl"):
        first, second = (getattr(c, column)[order] for c, order in zip(found, orders, strict=True))
        np.testing.assert_allclose(first, second, atol=1e-9)
    return len(names[0])


@pytest.mark.parametrize("fastest", [0.0, 0.3])
def test_contacts_are_the_same_whichever_way_they_are_found(fastest, rng):
    """By the watch and from the lists, at positions that are overwritten in place."""
    compared = 0
    for _ in range(6):
        X, watched = scene(rng, fastest=fastest)
        listed = Clearance(capsules(MEMBERS, 0.03), watched.obstacles, safe=0.08, influence=0.5, watch=False)
        Y = X.copy()
        for k, state in enumerate(walk(X, rng, 12, 0.05)):
            Y[:] = state
            compared += compare(watched, listed, Y, time=0.2 * k, self_reach=0.3, by_fcl=True)
    assert compared > 20


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
def test_pieces_that_are_gone_are_forgotten_with_their_pairs(rng):
    """Many balls, then few and none; the way goes on before anything is listed anew."""
    assert building().finish() is not None
    compared = 0
    for _ in range(3):
        place, watched = scene(rng)
        while min(distance for pair, distance in brute_force(watched, place, 0.0).items() if pair[2]) < 0.05:
            place, watched = scene(rng)
        for count in (60, 2, 30, 0, 1, 20):
            balls = [
                sphere(f"ball {k}", rng.uniform(-2.0, 2.0, 3), 0.1, 0.1 * rng.normal(size=3))
                for k in range(count)
            ]
            watched.put(balls)
            listed = Clearance(capsules(MEMBERS, 0.03), balls, safe=0.08, influence=0.5, watch=False)
            for k, state in enumerate(walk(place, rng, 4, 0.02)[1:]):
                assert watched.watching() is not None
                watched.along(np.stack([place, state]), 0.1 * k, 0.1 * (k + 1), -1.0, -1.0, thorough=False)
                place = state
                if min(brute_force(watched, state, 0.1 * (k + 1)).values()) > 0.0:
                    compared += compare(watched, listed, state, time=0.1 * (k + 1), self_reach=0.3)
    assert compared > 10


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
def test_a_list_that_is_full_by_chance_is_made_again_where_another_one_needs_room(rng):
    """There is room for 64 pairs of a shape at first: those with boxes are as many, those of rods 120."""
    assert building().finish() is not None
    rods, boxes = np.arange(32).reshape(16, 2), [box(f"box {k}", (k, 0.0, 0.0), 0.1) for k in range(4)]
    middle = rng.uniform(-1.0, 4.0, (16, 1, 3)) * (1.0, 0.3, 0.3)
    X = (middle + 0.1 * rng.normal(size=(16, 2, 3))).reshape(-1, 3)
    watched, listed = (
        Clearance(capsules(rods, 0.001), boxes, safe=0.01, influence=0.5, watch=watch)
        for watch in (True, False)
    )
    compared = 0
    for state in walk(X, rng, 8, 0.05):
        if min(brute_force(watched, state, 0.0).values()) > 0.0:
            assert watched.watching() is not None
            compared += compare(watched, listed, state, self_reach=0.5)
    assert compared > 20
    assert {pair[2] for pair, distance in brute_force(watched, X, 0.0).items() if distance < 0.5} == {
        False,
        True,
    }


@pytest.mark.parametrize("name", ["octahedral", "longeron", "graph"])
def test_members_that_end_in_offset_joints_are_watched_too(name, rng):
    arm = TrussArm(TRUSSES[name](joint_offset=0.1))
    obstacles = [box("box", [0.8, 0.0, 0.9], [0.3, 0.3, 0.3]), sphere("ball", [-0.7, 0.5, 1.0], 0.15)]
    watched, listed = (
        Clearance(arm.bodies, obstacles, safe=0.08, influence=0.5, watch=watch) for watch in (True, False)
    )
    assert watched.is_watched
    assert not listed.is_watched
    states = walk(arm.home_configuration, rng, 12, 0.02)
    reach = {"self_reach": 0.5, "by_fcl": True}
    assert sum(compare(watched, listed, arm.points(state), **reach) for state in states) > 10


def test_a_motion_is_proven_from_where_it_starts_though_its_array_was_overwritten():
    wall = box("wall", [1.0, 0.0, 0.0], [0.1, 4.0, 4.0])
    monitor = Clearance(capsules([(0, 1), (2, 3)], 0.03), [wall], safe=0.08, influence=0.5)
    X = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [-1.0, 0.0, 1.0]])
    assert monitor.along(np.stack([X, X + 0.1 * FORWARD]), 0.0, 0.0, 0.08).certified
    X += 2.0 * FORWARD
    assert not monitor.along(np.stack([X, X - 2.0 * FORWARD]), 0.0, 0.0, 0.08).certified
    for number in (np.nan, np.inf, 1e160):
        with pytest.raises(GeometryError, match="finite"):
            monitor.near(np.full(X.shape, number), tracked=True)


def test_a_pair_whose_centres_coincide_at_first_is_watched_like_every_other():
    """A bound that multiplies the distance of the centres by an infinite reach is no number there."""
    ball = sphere("ball", [0.0, 0.0, 0.5], 0.05)
    members = [(0, 1), (2, 3)]
    monitor = Clearance(capsules(members, 0.03), [ball], safe=0.08, influence=0.5)
    X = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [-0.5, 0.0, 0.5], [0.5, 0.0, 0.5]])
    watch = watch_of(monitor)
    assert watch.near(X, 0.0, 0.3, 0.3) is None
    clear = X + np.array([[0.0, 0.5, 0.0]] * 2 + [[0.0, -0.5, 0.0]] * 2)
    watch.near(clear, 0.0, 0.6, 1.2)
    found = watch.near(clear, 0.0, 0.6, 1.2)
    assert sorted(found.is_self.tolist()) == [False, False, True]
    assert not watch.follow(np.stack([clear, X]), 0.0, 0.0, 0.08, 0.02)
    assert len(every_pair(monitor.scene, X)[0]) == 2


def test_members_that_all_meet_at_one_node_have_nothing_to_watch():
    monitor = Clearance(capsules([(0, 3), (1, 3), (2, 3)], 0.03), [], safe=0.08, influence=0.5)
    X = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    watch = watch_of(monitor)
    assert not len(watch.near(X, 0.0, 0.5, 0.5).distance)
    assert watch.follow(np.stack([X, X + 0.1 * FORWARD]), 0.0, 0.0, 0.08, 0.02)
    with pytest.raises(GeometryError):
        watch.follow(np.stack([X, np.full(X.shape, np.nan)]), 0.0, 0.0, 0.08, 0.02)


@pytest.mark.parametrize("floor", [-0.05, -0.001, 0.0])
def test_floors_below_zero_are_those_of_surfaces_that_overlap_already(floor):
    wall = box("wall", [1.0, 0.0, 0.0], [0.1, 4.0, 4.0])
    monitor = Clearance(
        capsules([(0, 1), (1, 2)], 0.03), [wall], safe=0.08, influence=0.5, self_collision=False
    )
    X = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 2.0]]) + 0.93 * FORWARD
    watch = watch_of(monitor)
    assert not watch.follow(np.stack([X, X + 0.2 * FORWARD]), 0.0, 0.0, floor, floor)
    assert watch.follow(X + np.array([[[-0.2]], [[-0.1]]]) * FORWARD, 0.0, 0.0, floor, floor)


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("broken", range(3))
def test_a_pair_without_a_bound_is_never_proven_by_the_pairs_beside_it(broken):
    """Its distance is NaN in one state; in the next, nothing is known of its way."""
    assert building().finish() is not None
    ends, known = ca.SX.sym("ends", 24), ca.SX.sym("known", 19)
    contact = Kernel(ca.Function("contact", [ends, known], [ca.repmat(known[0], 19)]), compiled=False)
    pairs, way = Program("Pairs"), Program("Way")
    given = np.zeros((3, 15))
    given[:, 0] = 0.05
    given[broken, 0] = np.nan
    listed = np.array(
        [(k, k, 0.05) for k in range(3)], dtype=[("body", "i4"), ("other", "i4"), ("lower", "f8")]
    )
    pairs.set(count=3, is_self=0, listed=listed, normal=np.zeros((3, 3)))
    pairs.set(next=2.0, contact=contact, rows=np.zeros(3, dtype=np.int64), contacts=np.zeros((6, 9)))
    pairs.set(ends=contact.inputs[0], pair=contact.inputs[1], found=contact.outputs[0])
    way.set(pieces=1, points=2, bodies=3, groups=1, furthest=1e60, places=np.zeros((2, 2, 3)))
    way.set(
        ends=np.tile(np.array([0, 1], dtype=np.int32), 3), group=np.array([pairs.address], dtype=np.uintp)
    )
    way.set(solid=given, speed=np.zeros(3), allowance=np.zeros(3), radius=np.zeros(3))
    way.set(span=2, each=2, size=9)
    way.set(wanted=0.1, far=1.0, middle=np.zeros((3, 3)), turned=np.zeros(3), moved=np.zeros(3))
    way.set(place=np.zeros((2, 3)))
    for code in (Code.DONE, Code.NOT_PROVEN):
        assert way.call("prove_path") is code
        assert pairs.data.near == 3
        assert pairs.data.overlaps
    assert not pairs.data.lowest >= 0.0


def test_a_way_in_pieces_is_proven_where_each_piece_is(rng):
    """Round a corner: the straight way leads through the wall, and so does a way whose pieces touch it."""
    wall = box("wall", [1.0, 0.0, 0.0], [0.1, 2.0, 4.0])
    monitor = Clearance(capsules([(0, 1)], 0.03), [wall], safe=0.08, influence=0.5, self_collision=False)
    start = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    angles = np.linspace(np.pi, 0.0, 13)
    stops = np.stack([1.0 + np.cos(angles), 1.6 * np.sin(angles), 0.0 * angles], axis=1)
    round_it, through = start + stops[:, None], start + stops[[0, 12, 6]][:, None]
    for ask in (watch_of(monitor).follow, lambda *way: monitor.along(*way).certified):
        assert ask(round_it, 0.0, 1.0, 0.08, 0.0)
        assert not ask(through, 0.0, 1.0, 0.08, 0.0)
        assert ask(round_it, 0.0, 1.0, 0.08, 0.0)
    unwatched = Clearance(
        capsules([(0, 1)], 0.03), [wall], safe=0.08, influence=0.5, self_collision=False, watch=False
    )
    assert unwatched.along(round_it, 0.0, 1.0, 0.08).certified
    refused = unwatched.along(np.stack([start, start, start + 2.0 * FORWARD]), 0.0, 1.0, 0.08)
    assert not refused.certified
    # Half of the way is the first piece, in which nothing moves.
    assert 0.5 < refused.fraction[0] < 1.0
    for watched in (True, False):
        monitor = Clearance(
            capsules([(0, 1)], 0.03), [wall], safe=0.08, influence=0.5, self_collision=False, watch=watched
        )
        for _ in range(20):
            way = start + np.cumsum(rng.normal(scale=0.4, size=(6, 1, 3)), axis=0)
            pieces = [monitor.along(np.stack(piece), 0.0, 0.0, 0.08).certified for piece in pairwise(way)]
            assert monitor.along(way, 0.0, 1.0, 0.08).certified == all(pieces)


@pytest.mark.parametrize("bad", range(4))
def test_a_way_is_refused_for_the_one_piece_that_leads_through_something(bad):
    """To and fro beside a wall, in one piece through it and back: the pieces before are proven by the watch."""
    wall = box("wall", [1.0, 0.0, 0.0], [0.1, 0.1, 4.0])
    start = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    sides = np.cumsum([[0.0, 1.0, 0.0], *[[0.0, 0.2, 0.0]] * 4], axis=0)
    sides[bad + 1 :] += [2.0, 0.0, 0.0]
    sides[: bad + 1, 1], sides[bad + 1 :, 1] = sides[: bad + 1, 1] - sides[bad, 1], 0.2 * np.arange(4 - bad)
    for watch in (True, False):
        monitor = Clearance(
            capsules([(0, 1)], 0.03), [wall], safe=0.08, influence=0.5, self_collision=False, watch=watch
        )
        report = monitor.along(start + sides[:, None], 0.0, 1.0, 0.08)
        assert not report.certified
        assert 0.25 * bad < report.fraction[0] <= 0.25 * (bad + 1)
        for piece in set(range(4)) - {bad}:
            assert monitor.along(start + sides[piece : piece + 2, None], 0.0, 1.0, 0.08).certified
