import casadi as ca
import numpy as np
import pytest
from geometry_reference import POINT, segment_distance
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vgtm_qp.compiled import compiler, finish_compiling
from vgtm_qp.geometry.batch import Batch
from vgtm_qp.geometry.exact import (
    CONTACT,
    SECOND_CONTACT,
    distance_function,
    follow_function,
    sweep_function,
    width,
)
from vgtm_qp.geometry.formulas import FAR, FORMULAS, PARALLEL

BATCH = {shape: Batch(distance_function(shape)) for shape in FORMULAS}


def axis_distances(shape, ends, pieces):
    """Distances of segments (K, 6) from pieces (K, width), m."""
    return BATCH[shape](np.column_stack([ends, pieces, np.zeros(len(ends))]))[:, 0]


def contacts(shape, ends, piece):
    """The contacts of a segment: one, or two where the nearest point is not unique."""
    rows = BATCH[shape](np.concatenate([ends, piece, [0.0]])[None])[0].reshape(2, CONTACT)
    found = []
    for row in rows[rows[:, 0] < FAR]:
        t, normal = row[2], row[5:8]
        assert row[1] == 1.0 - t
        point = ends[:3] + t * (ends[3:] - ends[:3]) - row[0] * normal
        found.append({"distance": row[0], "t": t, "normal": normal, "point": point, "others": row[3:5]})
    return found


def contact(shape, ends, piece):
    return contacts(shape, ends, piece)[0]


def vectors(count, bound=2.0):
    """Coordinates in general position, and round ones that make members parallel to faces and edges."""
    general = st.lists(st.floats(-bound, bound), min_size=count, max_size=count)
    steps = st.integers(-int(4 * bound), int(4 * bound)).map(lambda k: k / 4.0)
    return st.one_of(general, st.lists(steps, min_size=count, max_size=count)).map(np.array)


rotations = st.one_of(
    st.integers(0, 2**31).map(lambda seed: Rotation.random(random_state=seed).as_matrix()),
    st.tuples(*[st.integers(0, 7)] * 3).map(
        lambda k: Rotation.from_euler("xyz", [45 * a for a in k], degrees=True).as_matrix()
    ),
    st.just(np.eye(3)),
)


@st.composite
def pieces(draw, shape):
    piece = np.zeros(width(shape))
    if shape == "segment":
        piece[:] = draw(vectors(6))
    elif shape == "triangle":
        piece[:9] = draw(vectors(9))
    else:
        piece[:3] = draw(vectors(3, 1.0))
        sizes = st.one_of(st.floats(0.05, 1.5), st.sampled_from([0.25, 0.5, 1.0]))
        if shape == "sphere":
            piece[12] = draw(sizes)
        else:
            piece[3:12] = draw(rotations).ravel()
            piece[12:15] = [draw(sizes) for _ in range(3)]
    return piece


cases = st.sampled_from(sorted(FORMULAS)).flatmap(
    lambda shape: st.tuples(st.just(shape), vectors(6), pieces(shape))
)


@pytest.mark.smoke
@settings(max_examples=500, deadline=None)
@given(cases)
def test_distance_is_exact_and_never_over_estimated(case):
    shape, ends, piece = case
    expected = segment_distance(shape, ends, piece)
    answer = contact(shape, ends, piece)
    assert all(np.isfinite(value).all() for value in answer.values())
    assert len(contacts(shape, ends, piece)) == 1 or shape != "sphere"
    if shape == "sphere" or expected > 1e-9:
        assert answer["distance"] <= expected + 1e-12
        assert answer["distance"] >= expected - 1e-9
    else:
        assert answer["distance"] <= 1e-9
    assert np.linalg.norm(answer["normal"]) == pytest.approx(1.0, abs=1e-9)


@settings(max_examples=300, deadline=None)
@given(cases)
def test_witness_points_and_second_contact_are_where_they_say(case):
    shape, ends, piece = case
    found = contacts(shape, ends, piece)
    assume(found[0]["distance"] > 1e-6)
    length = np.linalg.norm(ends[3:] - ends[:3])
    for one in found:
        t, distance, point = one["t"], one["distance"], one["point"]
        assert 0.0 <= t <= 1.0
        assert np.linalg.norm(one["normal"]) == pytest.approx(1.0, abs=1e-9)
        on_member = ends[:3] + t * (ends[3:] - ends[:3])
        assert distance == pytest.approx(float(POINT[shape](on_member, piece)), abs=1e-10)
        assert float(POINT[shape](point, piece)) <= 1e-8
        assert distance <= found[0]["distance"] + PARALLEL * length + 1e-9
        if shape == "segment":
            np.testing.assert_allclose(point, -one["others"] @ piece.reshape(2, 3), atol=1e-9)
            assert one["others"].sum() == pytest.approx(-1.0)
        else:
            assert not one["others"].any()
    if len(found) == 2:
        assert abs(found[1]["t"] - found[0]["t"]) >= SECOND_CONTACT


@settings(max_examples=200, deadline=None)
@given(cases)
def test_normal_is_the_gradient_of_the_distance(case):
    shape, ends, piece = case
    answer = contact(shape, ends, piece)
    # Where two witness points are equally near the distance has a kink.
    assume(answer["distance"] > 0.05 and len(contacts(shape, ends, piece)) == 1)
    expected = np.concatenate([(1.0 - answer["t"]) * answer["normal"], answer["t"] * answer["normal"]])
    step = 1e-6
    slopes = np.empty((6, 2))
    for i in range(6):
        for j, sign in enumerate((1.0, -1.0)):
            moved = ends.copy()
            moved[i] += sign * step
            slopes[i, j] = sign * (contact(shape, moved, piece)["distance"] - answer["distance"]) / step
    smooth = np.abs(slopes[:, 0] - slopes[:, 1]).max() < 1e-3
    assume(smooth)
    np.testing.assert_allclose(slopes.mean(axis=1), expected, atol=1e-3)


@settings(max_examples=200, deadline=None)
@given(vectors(6, 1.0), pieces("box"), st.integers(0, 2**31))
def test_depth_in_a_box_is_the_least_way_out(ends, piece, seed):
    answer = contact("box", ends, piece)
    depth = -answer["distance"]
    assume(depth > 1e-6)
    out = ends + np.tile((depth + 1e-9) * answer["normal"], 2)
    assert segment_distance("box", out, piece) >= 0.0
    assert contact("box", out, piece)["distance"] > -1e-8
    directions = np.random.default_rng(seed).normal(size=(30, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    inside = ends + np.tile(0.99 * depth * directions, 2)
    assert (axis_distances("box", inside, np.tile(piece, (30, 1))) <= 1e-9).all()


@settings(max_examples=100, deadline=None)
@given(vectors(6, 1.0), pieces("cylinder"))
def test_normal_in_a_cylinder_leads_out(ends, piece):
    answer = contact("cylinder", ends, piece)
    assume(segment_distance("cylinder", ends, piece) == 0.0)
    assert -1e-12 <= answer["distance"] <= 1e-12
    out = ends + np.tile((piece[12] + piece[13] + 1e-6) * answer["normal"], 2)
    assert contact("cylinder", out, piece)["distance"] >= 0.0
    assert abs(answer["normal"] @ piece[3:12].reshape(3, 3)[:, 2]) == pytest.approx(1.0) or (
        answer["normal"] @ piece[3:12].reshape(3, 3)[:, 2] == pytest.approx(0.0, abs=1e-9)
    )


@settings(max_examples=300, deadline=None)
@given(cases, vectors(6), st.floats(0.001, 1.0))
def test_distance_changes_by_no_more_than_the_ends_move(case, motion, size):
    shape, ends, piece = case
    moved = ends + size * motion
    travel = max(np.linalg.norm(size * motion[:3]), np.linalg.norm(size * motion[3:]))
    before, after = contact(shape, ends, piece), contact(shape, moved, piece)
    assert abs(before["distance"] - after["distance"]) <= travel + 1e-12


def test_member_parallel_to_a_face_has_a_contact_at_each_end_of_the_overlap():
    piece = np.r_[0.0, 0.0, 0.0, np.eye(3).ravel(), 0.5, 0.5, 0.5]
    found = contacts("box", np.array([-1.0, 0.0, 0.8, 1.0, 0.0, 0.8]), piece)
    assert [one["t"] for one in found] == pytest.approx([0.25, 0.75])
    assert [one["distance"] for one in found] == pytest.approx([0.3, 0.3])


def test_issue_508_case():
    piece = np.r_[1.0, 0.0, 0.75, np.eye(3).ravel(), 0.25, 0.25, 0.25]
    ends = np.array([1.0, 0.5, 0.0, 1.0, 2.0, 0.0])
    assert contact("box", ends, piece)["distance"] == pytest.approx(np.sqrt(0.25**2 + 0.5**2), abs=1e-15)


@pytest.mark.parametrize(
    ("other", "distance"),
    [
        ([0, 1, 0, 1, 1, 0], 1.0),
        ([2, 0, 0, 3, 0, 0], 1.0),
        ([0.5, -1, 0, 0.5, 1, 0], 0.0),
        ([0.5, 0, 0, 2, 0, 0], 0.0),
        ([3, 4, 0, 3, 4, 0], np.hypot(2, 4)),
        ([0, 1e-9, 0, 1, -1e-9, 0], 0.0),
    ],
)
def test_degenerate_segments(other, distance):
    answer = contact("segment", np.array([0.0, 0, 0, 1, 0, 0]), np.array(other, dtype=float))
    assert answer["distance"] == pytest.approx(distance, abs=1e-15)
    assert np.linalg.norm(answer["normal"]) == pytest.approx(1.0)


@settings(max_examples=300, deadline=None)
@given(cases, vectors(6), vectors(6), st.floats(0.01, 1.0))
def test_sweep_bound_holds_at_every_instant(case, motion, other_motion, size):
    shape, ends, piece = case
    end = ends + size * motion
    moved = piece + size * other_motion if shape == "segment" else piece
    pairs = [np.concatenate([*pair, [0.0]]) for pair in ((ends, piece), (end, moved))]
    bound, at_start, at_end = np.asarray(sweep_function(shape)(*pairs)).ravel()
    s = np.linspace(0.0, 1.0, 41)[:, None]
    sampled = axis_distances(shape, ends + s * (end - ends), piece + s * (moved - piece))
    assert bound <= sampled.min() + 1e-12
    assert (at_start, at_end) == pytest.approx((sampled[0], sampled[-1]), abs=1e-12)
    wide = [np.append(pair[:-1], 0.03) for pair in pairs]
    np.testing.assert_allclose(
        np.asarray(sweep_function(shape)(*wide)).ravel(),
        [bound - 0.03, at_start - 0.03, at_end - 0.03],
        atol=1e-12,
    )


@settings(max_examples=300, deadline=None)
@given(cases, vectors(6), vectors(6), vectors(3), st.floats(0.01, 1.0), st.floats(0.0, 0.2))
def test_a_pair_that_is_followed_has_its_contacts_and_a_bound_whatever_normal_it_comes_with(
    case, motion, other_motion, direction, size, radius
):
    shape, ends, piece = case
    assume(np.linalg.norm(direction) > 1e-3)
    normal = direction / np.linalg.norm(direction)
    end, mutual = ends + size * motion, shape == "segment"
    moved = piece + size * other_motion if mutual else piece
    before = np.concatenate([ends, piece if mutual else np.zeros(6)]).reshape(4, 3)
    after = np.concatenate([end, moved if mutual else np.zeros(6)]).reshape(4, 3)
    known = np.concatenate([np.zeros(15) if mutual else piece, [radius], normal])
    both = np.concatenate([before, after]).reshape(-1)
    *found, bound = np.asarray(follow_function(shape)(both, known)).ravel()
    rows = np.reshape(found, (2, CONTACT))
    s = np.linspace(0.0, 1.0, 41)[:, None]
    sampled = axis_distances(shape, ends + s * (end - ends), piece + s * (moved - piece))
    assert bound <= max(sampled.min(), 0.0 if shape != "sphere" else -np.inf) - radius + 1e-12
    wanted = contacts(shape, end, moved)
    assume(wanted[0]["distance"] > 1e-6)
    rows = rows[rows[:, 0] < FAR]
    assert rows[0, 0] + radius == pytest.approx(wanted[0]["distance"], abs=1e-12)
    for row in rows:
        place, normal = row[1:3] @ after[:2], row[5:8]
        apart = axis_distances(shape, np.tile(place, 2)[None], moved[None])[0]
        assert row[0] + radius == pytest.approx(apart, abs=1e-9)
        assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-12)
        if mutual:
            np.testing.assert_allclose(place + row[3:5] @ after[2:], normal * apart, atol=1e-9)
    # Of points that are equally near, rounding chooses: a hair's breadth elsewhere, others are nearest.
    moves = np.random.default_rng(0).normal(size=(4, 6))
    nearby = [contacts(shape, end + 1e-10 * move, moved) for move in moves]
    if all(len(other) == len(wanted) and same_places(other, wanted) for other in nearby):
        assert len(rows) == len(wanted)
        for row, one in zip(rows, wanted, strict=True):
            assert row[0] + radius == pytest.approx(one["distance"], abs=1e-12)
            np.testing.assert_allclose(row[5:8], one["normal"], atol=1e-9)
            other = -row[3:5] @ after[2:] if mutual else one["point"]
            np.testing.assert_allclose(row[1:3] @ after[:2] - other, row[5:8] * one["distance"], atol=1e-9)


def same_places(contacts, others):
    """Whether contacts are at the same places, to 1e-6 of a body's length and 1e-6 rad."""
    return all(
        abs(a["t"] - b["t"]) < 1e-6 and np.abs(a["normal"] - b["normal"]).max() < 1e-6
        for a, b in zip(contacts, others, strict=True)
    )


@pytest.mark.smoke
@pytest.mark.parametrize("count", [1, 16, 17, 65, 300, 1500])
def test_batches_of_any_size_equal_single_rows(count, rng):
    ends, others = rng.normal(size=(count, 6)), rng.normal(size=(count, 6))
    pairs = np.column_stack([ends, others, np.zeros(count)])
    rows = BATCH["segment"](pairs)
    assert rows.shape == (count, 2 * CONTACT)
    for k in {0, count // 2, count - 1}:
        # One of them may be interpreted still.
        np.testing.assert_allclose(rows[k], BATCH["segment"](pairs[k : k + 1])[0], rtol=1e-14, atol=1e-13)


def test_a_batch_gives_the_same_answers_once_it_is_compiled(rng):
    pair = ca.SX.sym("pair", 13)
    batch = Batch(ca.Function("distance_again", [pair], [distance_function("segment")(pair)]))
    pairs = rng.normal(size=(130, 13))
    sizes = (3, 8, 9, 130)
    expected = [batch(pairs[:size]) for size in sizes]
    finish_compiling()
    for size, rows in zip(sizes, expected, strict=True):
        np.testing.assert_allclose(batch(pairs[:size]), rows, rtol=0.0, atol=1e-12)
    wanted = dict.fromkeys((8, 16, 256), compiler() is not None)
    assert {capacity: kernel.is_compiled for capacity, (kernel, *_) in batch.kernels.items()} == wanted
