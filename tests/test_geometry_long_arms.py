import numpy as np
import pytest
from brute_force import every_pair
from geometry_reference import octahedral_arm
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vgtm_qp.compiled import compiler
from vgtm_qp.geometry.bodies import capsules
from vgtm_qp.geometry.candidates import Candidates
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.geometry.shapes import box, sphere
from vgtm_qp.geometry.watch import Watch

BAYS = 40


def long_arm(bays=BAYS):
    """Nodes, and a monitor of an arm with two obstacles, whose lists are not of all pairs."""
    X, members = octahedral_arm(bays)
    height = float(X[:, 2].max())
    obstacles = [box("cube", (1.2, 0.0, 0.7 * height), 0.5), sphere("ball", (-1.5, 0.3, 0.4 * height), 0.4)]
    return X, Clearance(capsules(members, 0.03), obstacles, safe=0.08, influence=0.5)


def turned(X, first, rotation):
    """The arm with all faces from `first` on turned about that one, m."""
    bent = X.copy()
    center = X[3 * first : 3 * first + 3].mean(axis=0)
    bent[3 * first :] = center + (X[3 * first :] - center) @ rotation.as_matrix().T
    return bent


def every_distance(monitor, X):
    """Distance of each body to each piece (B, P), and of each body to each other (B, B), by is_self, m.

    It is infinite for what is no pair. Each pair is evaluated alone.
    """
    bodies, pieces = len(monitor.bodies.points), len(monitor.pieces.shape)
    exact = {False: np.full((bodies, pieces), np.inf), True: np.full((bodies, bodies), np.inf)}
    for group in every_pair(monitor.scene, X):
        exact[group.is_self][group.body, group.other] = group.distance
    exact[True] = np.minimum(exact[True], exact[True].T)
    return exact


def counted(found, is_self, shape):
    """How many rows of what was found each pair has, as an array like that of its distances."""
    counts, rows = np.zeros(shape, dtype=int), found.is_self == is_self
    np.add.at(counts, (found.body[rows], found.other[rows]), 1)
    return counts + counts.T if is_self else counts


def bends(rng, X, count):
    """States of an arm that goes as a whole, bends at a few joints, and now and then folds or jumps home."""
    home, hinges = X, rng.integers(1, BAYS, 2)
    for _ in range(count):
        kind = rng.choice(["goes", "bends", "bends", "wobbles", "folds", "home"])
        if kind == "goes":
            X = X + rng.normal(size=3) * 0.3
        elif kind == "bends":
            X = turned(X, rng.choice(hinges), Rotation.from_rotvec(rng.normal(size=3) * 0.1))
        elif kind == "wobbles":
            X = X + rng.normal(size=X.shape) * 0.02
        elif kind == "folds":
            X = turned(X, rng.integers(1, BAYS), Rotation.from_rotvec([0.0, rng.choice([1.5, 2.9]), 0.0]))
        else:
            X = home
        yield X


def loose_rods(rng):
    """Nodes, and a monitor of short rods that fill a long box: pairs are at all distances."""
    middle = rng.uniform(0.0, 1.0, size=(160, 3)) * (1.5, 1.5, 12.0)
    X = np.stack([middle, middle + 0.1 * rng.normal(size=(160, 3))], axis=1).reshape(-1, 3)
    members = np.arange(320).reshape(-1, 2)
    return X, Clearance(
        capsules(members, 0.001), [sphere("ball", (3.0, 0.0, 5.0), 0.5)], safe=0.08, influence=0.5
    )


def squeezes(rng, X, count):
    """States of rods that are carried far, are drawn together at a place, and go back now and then."""
    home, places = X, rng.uniform(0.0, 12.0, size=2)
    for _ in range(count):
        if rng.random() < 0.1:
            X = home
        way = X - (X.mean(axis=0) * (1, 1, 0) + (0, 0, rng.choice(places)))
        pull = rng.choice([0.02, 0.2]) * np.exp(-((way / 2.0) ** 2).sum(axis=1, keepdims=True))
        X = X - pull * way + np.array([0.2, 0.2, 0.0])
        yield X


def scene_and_states(seed, rods, count):
    rng = np.random.default_rng(seed)
    X, monitor = loose_rods(rng) if rods else long_arm()
    return rng, monitor, X, (squeezes if rods else bends)(rng, X, count)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**31), st.booleans(), st.booleans())
def test_no_near_pair_of_what_bends_is_missed(seed, rods, tracked):
    rng, monitor, _, states = scene_and_states(seed, rods, 8)
    for state in states:
        exact = every_distance(monitor, state)
        reach, self_reach = rng.choice([0.2, 0.5]), rng.choice([0.1, 0.22, 0.5])
        near = monitor.near(state, 0.0, reach, self_reach=self_reach, tracked=tracked)
        for is_self, limit in ((False, reach), (True, self_reach)):
            counts = counted(near, is_self, exact[is_self].shape)
            np.testing.assert_array_equal(counts > 0, exact[is_self] < limit)
            # A pair has two rows at most, however many lists there are.
            assert counts.max() <= 2
            rows = near.is_self == is_self
            assert (near.distance[rows] >= exact[is_self][near.body[rows], near.other[rows]] - 1e-9).all()
        floors = {False: rng.choice([0.0, 0.08]), True: rng.choice([0.0, 0.03])}
        keeps = all((exact[is_self] >= floor).all() for is_self, floor in floors.items())
        assert monitor.keeps(state, 0.0, floors[False], floors[True]) == keeps


@pytest.mark.dear
@pytest.mark.skipif(compiler() is None, reason="no C compiler")
@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**31), st.booleans())
def test_what_a_watch_proves_of_what_bends_holds_all_the_way(seed, rods):
    """Small motions, after which pairs are listed anew now and then, and a watch that knows more than the state."""
    rng, monitor, X, _ = scene_and_states(seed, rods, 0)
    watch = Watch(monitor.scene, monitor.influence, monitor.self_influence)
    for state in (squeezes if rods else bends)(rng, X, 12):
        way = rng.choice([0.1, 0.3]) * (state - X)
        exact = every_distance(monitor, X)
        floors = [
            max(0.0, rng.choice([0.5, 0.9]) * min(exact[is_self].min(), 0.4)) for is_self in (False, True)
        ]
        if rng.random() < 0.7:
            watch.near(X, 0.0, floors[0] + 0.1, floors[1] + 0.1)
        is_proven = watch.follow(np.stack([X, X + 0.5 * way, X + way]), 0.0, 0.0, *floors)
        for share in (0.2, 0.5, 0.8, 1.0) if is_proven else ():
            for is_self, distances in every_distance(monitor, X + share * way).items():
                assert distances.min() >= floors[is_self] - 1e-9
        X = X + way


def test_an_obstacle_that_begins_to_move_is_listed_before_it_is_near():
    X, monitor = long_arm()
    height = float(X[:, 2].max())

    def ball(velocity):
        return [sphere("ball", (5.0, 0.0, 0.5 * height), 0.4, velocity)]

    monitor.put(ball((0.0, 0.0, 0.0)))
    assert not len(monitor.near(X, 0.0, 0.5, self_reach=0.1, tracked=True))
    monitor.put(ball((-1.0, 0.0, 0.0)))
    proven = []
    for time in 0.1 * np.arange(50):
        proven.append(monitor.along(np.stack([X, X]), time, time + 0.1, 0.08, 0.0, thorough=False).certified)
        assert not proven[-1] or monitor.least(X, time + 0.1, among="obstacles")[0] >= 0.08 - 1e-9
    assert proven[0]
    assert not proven[-1]


def check_bounds(candidates, motion, exact):
    """Assert that no bound exceeds the distance it bounds."""
    listed = {is_self: np.zeros(table.shape, dtype=bool) for is_self, table in exact.items()}
    for group in candidates.groups:
        table, pairs = listed[group.is_self], (group.body, group.other)
        assert not table[pairs].any()
        table[pairs] = True
        if group.is_self:
            table[pairs[::-1]] = True
        distances = exact[group.is_self][pairs]
        for limit in (0.1, np.inf):
            lower, others = group.lower(motion, limit)
            assert (lower <= distances[: len(lower)] + 1e-9).all()
            assert (others <= distances[len(lower) :] + 1e-9).all()
    for is_self, far in zip((False, True), candidates.beyond(motion), strict=True):
        assert (exact[is_self][~listed[is_self]] >= far - 1e-9).all()


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**31), st.booleans(), st.booleans())
def test_bounds_of_what_bends_never_exceed_the_distances(seed, rods, refreshed):
    rng, monitor, X, states = scene_and_states(seed, rods, 10)
    candidates = Candidates(monitor.scene, monitor.influence, monitor.self_influence)
    candidates.cover(X, 0.0, monitor.influence, monitor.self_influence)
    before = X
    for state in states:
        # Lists are brought up to a state, and hold for the way to another one.
        candidates.cover(before, 0.0, 0.0, rng.choice([0.0, 0.2]))
        check_bounds(candidates, candidates.motion(before, 0.0), every_distance(monitor, before))
        check_bounds(candidates, candidates.motion(before, 0.0, state, 0.0), every_distance(monitor, state))
        if refreshed:
            for group in candidates.groups:
                candidates.count_unneeded(group, 10**6)
            candidates.refresh_where_due(state, 0.0)
            check_bounds(candidates, candidates.motion(state, 0.0), every_distance(monitor, state))
        before = state


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.02, 0.4))
def test_what_is_proven_of_an_arm_that_bends_holds_on_the_way(seed, size):
    rng = np.random.default_rng(seed)
    X, monitor = long_arm()
    start = X
    for _ in range(4):
        end = turned(start, rng.integers(1, BAYS), Rotation.from_rotvec(rng.normal(size=3) * size))
        report = monitor.along(np.stack([start, end]), 0.0, 0.0, 0.02, 0.01)
        for s in np.linspace(0.0, 1.0, 6) if report.certified else ():
            exact = every_distance(monitor, start + s * (end - start))
            assert exact[False].min() >= 0.02 - 1e-9
            assert exact[True].min() >= 0.01 - 1e-9
        start = end


class CountedCandidates(Candidates):
    """Counts how often all bodies are compared with each other."""

    renewed = 0

    def renew_bodies(self, *arguments):
        self.renewed += 1
        super().renew_bodies(*arguments)


@pytest.mark.parametrize("hinge", [None, BAYS - 3])
def test_an_arm_that_is_carried_or_bends_in_one_place_is_compared_once(hinge):
    X, monitor = long_arm()
    candidates = CountedCandidates(monitor.scene, monitor.influence, monitor.self_influence)
    nearer = 0
    for k in range(40):
        state = X + np.array([0.3 * k, 0.1 * k, 0.0])
        if hinge is not None:
            state = turned(state, hinge, Rotation.from_rotvec((0.0, 0.06 * k, 0.0)))
        motion = candidates.cover(state, 0.0, 0.5, 0.22)
        exact = every_distance(monitor, state)
        check_bounds(candidates, motion, exact)
        assert min(candidates.beyond(motion)) >= 0.22
        assert sum(map(len, candidates.groups)) < 5000
        near = monitor.near(state)
        for is_self, limit in ((False, 0.5), (True, 0.22)):
            counts = counted(near, is_self, exact[is_self].shape)
            np.testing.assert_array_equal(counts > 0, exact[is_self] < limit)
        nearer += int(near.is_self.sum())
    assert candidates.renewed == 1
    assert (nearer > 0) == (hinge is not None)
