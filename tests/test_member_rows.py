"""The rows of members as functions of numbers, against the formulas and against differences, away from any truss."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from arms import central_differences
from hypothesis import given, settings
from hypothesis import strategies as st

from vgtm_qp.rows.members import (
    LengthScatter,
    fixed_error,
    joint_frames,
    length_nodes,
    length_rhs,
    member_end_function,
    member_ends,
    member_function,
)

MEMBERS = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [0, 2], [1, 3]])
TRIANGLE = np.array([[0, 1, 2], [1, 2, 3], [2, 3, 0], [3, 0, 1]])
FREE = np.array([3, 1])


def nodes_at(seed):
    rng = np.random.default_rng(seed)
    return rng, np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0.2], [0, 1.2, 0.5]]) + 0.1 * rng.normal(size=(4, 3))


def ends_of(X, offset):
    return X[MEMBERS] if offset is None else member_ends(X, MEMBERS, TRIANGLE, offset)


def lengths_of(X, offset):
    return np.linalg.norm(np.diff(ends_of(X, offset), axis=1)[:, 0], axis=1)


def rows_of(X, offset):
    """Lengths (M,) and their gradients (M, Q, 3) by the package's function of symbols."""
    nodes = length_nodes(MEMBERS, None if offset is None else TRIANGLE)
    function = member_function(has_offsets=offset is not None).map(len(MEMBERS))
    found = function(X[nodes].reshape(-1, 3).T, *([] if offset is None else [offset.reshape(-1, 3).T]))
    length, gradient = (np.array(part) for part in found)
    return length[0], gradient.T.reshape(len(MEMBERS), -1, 3)


def offsets(rng, has):
    return 0.1 * rng.normal(size=(len(MEMBERS), 2, 3)) if has else None


@pytest.mark.smoke
@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 100_000))
def test_ends_in_symbols_are_those_in_arrays_and_their_jacobians_the_derivatives(seed):
    rng, X = nodes_at(seed)
    offset = offsets(rng, has=True)
    frames = joint_frames(X, TRIANGLE)
    np.testing.assert_allclose(np.swapaxes(frames, 1, 2) @ frames, np.tile(np.eye(3), (4, 1, 1)), atol=1e-13)
    normal = np.cross(X[TRIANGLE[:, 1]] - X, X[TRIANGLE[:, 2]] - X)
    assert (np.einsum("nc,nc->n", frames[:, :, 2], normal) > 0.0).all()
    wanted, function = ends_of(X, offset), member_end_function()
    for member, end in np.ndindex(len(MEMBERS), 2):
        corners = X[TRIANGLE[MEMBERS[member, end]]]
        found, jacobian = function(corners.T, offset[member, end])
        np.testing.assert_allclose(np.array(found)[:, 0], wanted[member, end], atol=1e-13)
        change = central_differences(
            lambda Y, o=offset[member, end]: np.array(function(Y.T, o)[0])[:, 0], corners
        )
        np.testing.assert_allclose(np.array(jacobian), change.reshape(3, 9), atol=1e-8)


@pytest.mark.smoke
@pytest.mark.parametrize("has_offsets", [False, True])
@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 100_000))
def test_lengths_and_the_whole_jacobian_are_those_of_the_ends(has_offsets, seed):
    rng, X = nodes_at(seed)
    offset = offsets(rng, has_offsets)
    length, gradient = rows_of(X, offset)
    np.testing.assert_allclose(length, lengths_of(X, offset), atol=1e-13)
    wanted = central_differences(lambda Y: lengths_of(Y, offset), X)
    scatter = LengthScatter(length_nodes(MEMBERS, TRIANGLE if has_offsets else None), FREE, len(X))
    np.testing.assert_allclose(scatter.dense(gradient), wanted[:, FREE].reshape(len(MEMBERS), -1), atol=1e-8)
    np.testing.assert_array_equal(scatter.sparse(gradient).toarray(), scatter.dense(gradient))


@pytest.mark.smoke
@pytest.mark.parametrize("has_offsets", [False, True])
@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 100_000))
def test_free_nodes_that_meet_the_rows_keep_fixed_lengths_while_the_base_moves(has_offsets, seed):
    """J d_rho = rhs for a motion of all nodes that is known: what lengths change, base and free nodes together."""
    rng, X = nodes_at(seed)
    offset, actuated = offsets(rng, has_offsets), rng.random(len(MEMBERS)) < 0.4
    length, gradient = rows_of(X, offset)
    nodes = length_nodes(MEMBERS, TRIANGLE if has_offsets else None)
    motion, h = rng.normal(size=X.shape), 1e-6
    base = motion.copy()
    base[FREE] = 0.0
    change = (lengths_of(X + h * motion, offset) - lengths_of(X - h * motion, offset)) / (2.0 * h)
    # Homes that the fixed members have after the motion, to first order.
    error = fixed_error(ca.DM(length), ca.DM(length + change), actuated)
    np.testing.assert_allclose(np.array(error)[:, 0], np.where(actuated, 0.0, change), atol=1e-12)
    rhs = np.array(length_rhs(error, ca.DM(gradient.reshape(-1)), ca.DM(base.T), nodes))[:, 0]
    scatter = LengthScatter(nodes, FREE, len(X))
    left = scatter.dense(gradient) @ motion[FREE].reshape(-1)
    np.testing.assert_allclose(left - np.where(actuated, change, 0.0), rhs, atol=1e-7)
    np.testing.assert_allclose(np.array(error)[:, 0] - rhs, scatter.base_rate(gradient, motion), atol=1e-12)
