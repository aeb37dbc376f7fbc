"""Reference shape curves: weights, frames and Jacobians, closest points, degree of redundancy."""
