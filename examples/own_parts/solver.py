"""A QP solver of one's own: least distance programming by non-negative least squares (Lawson and Hanson, 1974)."""

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import nnls

import vgtm_qp as vq


def least_distance(P, q, A, lower, upper):
    """Return x and the multipliers of the rows, or None; its answers are checked as those of all solvers."""
    root = cholesky(P, lower=True)
    shift = solve_triangular(root, q, lower=True)
    rows = solve_triangular(root, A.T, lower=True).T  # over z = root' x + shift
    below, above = np.isfinite(lower), np.isfinite(upper)
    sides = np.concatenate([rows[below], -rows[above]])  # sides z >= bounds
    bounds = np.concatenate([(lower + rows @ shift)[below], -(upper + rows @ shift)[above]])
    forces, _ = nnls(np.vstack([sides.T, bounds]), np.eye(len(q) + 1)[-1])
    scale = 1.0 - bounds @ forces
    if scale < 1e-14:
        return None
    y = np.zeros(len(A))
    y[below] -= forces[: below.sum()] / scale
    y[above] += forces[below.sum() :] / scale
    return solve_triangular(root.T, sides.T @ forces / scale - shift), y


vq.register("solver", "least-distance", least_distance)
maneuver = vq.solve(vq.load_problem("five_bay_two_cubes").replace({"method.solver": "least-distance"}))
print(f"{maneuver.status} in {maneuver.steps} steps; verified: {maneuver.certificate.ok}")
