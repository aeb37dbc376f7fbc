"""Generalised inverses against their definitions, and the banded KKT form against the dense one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vgtm_qp.errors import SolverError
from vgtm_qp.methods.conventional import BandedSystem
from vgtm_qp.methods.pseudoinverse import (
    Cost,
    moore_penrose,
    null_space_vector,
    projector,
    weighted,
)

SEEDS = st.integers(0, 10_000)


def random_metric(random: np.random.Generator, size: int) -> np.ndarray:
    root = random.normal(size=(size, size))
    return root @ root.T + 0.1 * np.eye(size)


@pytest.mark.smoke
@settings(max_examples=30, deadline=None)
@given(SEEDS, st.integers(1, 6), st.integers(1, 6))
def test_moore_penrose_meets_its_four_conditions_at_any_rank(seed: int, rows: int, rank: int) -> None:
    random = np.random.default_rng(seed)
    J = random.normal(size=(rows, rank)) @ random.normal(size=(rank, 7))
    inverse = moore_penrose(J)
    P = inverse.matrix
    assert inverse.rank == min(rows, rank)
    scale = np.abs(P).max() * np.abs(J).max() ** 2
    np.testing.assert_allclose(J @ P @ J, J, atol=1e-11 * scale)
    np.testing.assert_allclose(P @ J @ P, P, atol=1e-11 * scale * np.abs(P).max())
    np.testing.assert_allclose(J @ P, (J @ P).T, atol=1e-11 * scale)
    np.testing.assert_allclose(P @ J, (P @ J).T, atol=1e-11 * scale)


@pytest.mark.smoke
@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_weighted_inverse_is_the_least_weighted_norm(seed: int) -> None:
    random = np.random.default_rng(seed)
    J, W, x = random.normal(size=(4, 9)), random_metric(random, 9), random.normal(size=4)
    d = weighted(J, W).matrix @ x
    np.testing.assert_allclose(J @ d, x, atol=1e-9)
    # Optimal: W d is in the row space, so that no motion of the null space is downhill.
    free = projector(moore_penrose(J), J)
    np.testing.assert_allclose(free @ (W @ d), 0.0, atol=1e-8 * np.abs(W @ d).max())


@pytest.mark.smoke
def test_damped_inverse_solves_the_damped_least_squares_problem(rng) -> None:
    J, W, x, damping = rng.normal(size=(4, 9)), random_metric(rng, 9), rng.normal(size=4), 0.3
    d = weighted(J, W, damping=damping).matrix @ x
    expected = np.linalg.solve(J.T @ J / damping**2 + W, J.T @ x / damping**2)
    np.testing.assert_allclose(d, expected, atol=1e-10)


@pytest.mark.smoke
def test_truncated_inverse_drops_the_small_singular_values(rng) -> None:
    u, v = np.linalg.qr(rng.normal(size=(3, 3)))[0], np.eye(3, 5)
    J = u @ np.diag([1.0, 0.1, 1e-4]) @ v
    inverse = moore_penrose(J, truncation=1e-3)
    assert inverse.rank == 2
    assert np.linalg.norm(inverse.matrix, 2) == pytest.approx(10.0)


@pytest.mark.smoke
def test_dependent_rows_are_refused_by_the_weighted_inverse() -> None:
    J = np.array([[1.0, 2.0, 0.0], [2.0, 4.0, 0.0]])
    with pytest.raises(SolverError, match="dependent"):
        weighted(J, np.eye(3))


@pytest.mark.smoke
@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_the_null_space_vector_gives_the_constrained_minimiser(seed: int) -> None:
    random = np.random.default_rng(seed)
    J, x = random.normal(size=(3, 8)), random.normal(size=3)
    objective = Cost(random_metric(random, 8), random.normal(size=8))
    inverse = moore_penrose(J)
    N = projector(inverse, J)
    start = inverse.matrix @ x
    d = start + N @ null_space_vector(N, start, objective)
    kkt = np.block([[objective.hessian, J.T], [J, np.zeros((3, 3))]])
    expected = np.linalg.solve(kkt, np.concatenate([-objective.gradient, x]))[:8]
    np.testing.assert_allclose(d, expected, atol=1e-8)


@pytest.mark.smoke
@settings(max_examples=20, deadline=None)
@given(SEEDS, st.integers(2, 40))
def test_banded_system_solves_what_a_dense_one_does(seed: int, size: int) -> None:
    random = np.random.default_rng(seed)
    rows = np.concatenate([np.arange(size), random.integers(0, size, 3 * size)])
    columns = np.concatenate([np.arange(size), random.integers(0, size, 3 * size)])
    values = np.concatenate([np.full(size, 16.0), random.uniform(-1, 1, 3 * size)])
    dense = np.zeros((size, size))
    np.add.at(dense, (rows, columns), values)
    dense += dense.T - np.diag(np.diag(dense))
    rhs = random.normal(size=size)
    np.testing.assert_allclose(
        BandedSystem(rows, columns).solve(values, rhs), np.linalg.solve(dense, rhs), atol=1e-10
    )


@pytest.mark.smoke
def test_a_singular_banded_system_is_refused() -> None:
    system = BandedSystem(np.array([0, 1, 1]), np.array([0, 1, 0]))
    with pytest.raises(SolverError, match="singular"):
        system.solve(np.ones(3), np.ones(2))
