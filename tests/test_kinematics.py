"""Lengths, face frames, tip pose and every row of their Jacobians against differences, for every module."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import oracle
import pytest
from arms import TRUSSES, central_differences, make_layout, random_pose
from scipy.spatial.transform import Rotation

from vgtm_qp.arm.truss.arm import TrussArm

OFFSETS = (0.0, 0.12)


@pytest.fixture(
    params=[(name, offset) for name in TRUSSES for offset in OFFSETS], ids=lambda p: f"{p[0]}-{p[1]}"
)
def truss(request):
    name, offset = request.param
    return TRUSSES[name](joint_offset=offset)


@pytest.fixture
def kinematics(truss):
    return TrussArm(truss).kinematics(compiled=False)


def lengths_of(truss, X):
    ends = truss.member_ends(X)
    return np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)


def spin_by_differences(rotation_at, X, h=1e-6):
    """Angular velocity rows (..., 3, X.size) of a rotation that depends on X."""
    columns = []
    for step in h * np.eye(X.size):
        ahead, behind = rotation_at(X + step.reshape(X.shape)), rotation_at(X - step.reshape(X.shape))
        turn = ahead @ np.swapaxes(behind, -1, -2)
        columns.append(
            Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec().reshape(*turn.shape[:-1]) / (2 * h)
        )
    return np.stack(columns, axis=-1)


def scattered(rows, nodes, count):
    """Rows (..., 3K) with respect to K nodes as rows with respect to all nodes."""
    out = np.zeros((*rows.shape[:-1], count, 3))
    for slot, node in enumerate(nodes):
        out[..., node, :] += rows[..., 3 * slot : 3 * slot + 3]
    return out.reshape(*rows.shape[:-1], -1)


def test_at_home_everything_is_as_the_truss_says(truss, kinematics):
    kinematics.evaluate(truss.home)
    np.testing.assert_allclose(kinematics.quantities, truss.home_lengths, atol=1e-14)
    np.testing.assert_allclose(kinematics.station_rotation, truss.face_frames, atol=1e-14)
    np.testing.assert_allclose(kinematics.tip_rotation, truss.tip_frame, atol=1e-14)
    arm = TrussArm(truss)
    np.testing.assert_allclose(
        arm.end_effector.position(truss.home), truss.tip_weights @ truss.home[truss.tip]
    )
    np.testing.assert_allclose(arm.measured(truss.home), truss.home_lengths, atol=1e-14)


@pytest.mark.smoke
def test_lengths_are_those_between_member_ends_and_gradients_their_derivatives(truss, kinematics, rng):
    X = random_pose(truss, rng)
    kinematics.evaluate(X)
    np.testing.assert_allclose(kinematics.quantities, lengths_of(truss, X), atol=1e-14)
    np.testing.assert_allclose(TrussArm(truss).measured(X), lengths_of(truss, X), atol=1e-14)
    gradient = np.zeros((truss.member_count, truss.node_count, 3))
    for slot in range(truss.member_nodes.shape[1]):
        np.add.at(
            gradient,
            (np.arange(len(gradient)), truss.member_nodes[:, slot]),
            kinematics.gradient[:, slot],
        )
    np.testing.assert_allclose(gradient, central_differences(lambda Y: lengths_of(truss, Y), X), atol=2e-9)


def test_length_jacobian_has_the_free_nodes_columns_and_the_base_the_rest(truss, kinematics, rng):
    X = random_pose(truss, rng)
    layout, _ = make_layout(truss)
    kinematics.evaluate(X)
    wanted = central_differences(lambda Y: lengths_of(truss, Y), X)
    free = wanted[:, truss.free].reshape(truss.member_count, -1)
    reused = np.zeros((truss.member_count, layout.node_columns))
    for _ in range(2):
        np.testing.assert_allclose(truss.scatter.dense(kinematics.gradient, reused), free, atol=2e-9)
    np.testing.assert_allclose(truss.scatter.dense(kinematics.gradient), free, atol=2e-9)
    np.testing.assert_allclose(truss.scatter.sparse(kinematics.gradient).toarray(), free, atol=2e-9)
    moved = np.where(truss.base[:, None], rng.normal(size=X.shape), 0.0)
    rate = truss.scatter.base_rate(kinematics.gradient, moved)
    np.testing.assert_allclose(rate, np.einsum("mnc,nc->m", wanted, moved), atol=2e-8)
    everywhere = rng.normal(size=X.shape)
    only_base = np.where(truss.base[:, None], everywhere, 0.0)
    np.testing.assert_allclose(
        truss.scatter.base_rate(kinematics.gradient, everywhere),
        truss.scatter.base_rate(kinematics.gradient, only_base),
        atol=1e-12,
    )


def test_stages_order_the_length_jacobian_block_lower_triangular(truss):
    nodes = truss.members if truss.joints is None else truss.joints.triangle[truss.members].reshape(-1, 6)
    assert np.all(truss.stage[nodes].max(axis=1) <= truss.stage[truss.members].max(axis=1))


def test_face_spins_are_the_angular_velocity_rows_of_the_face_frames(truss, kinematics, rng):
    X = random_pose(truss, rng)

    def rotations(Y):
        kinematics.evaluate(Y)
        return kinematics.station_rotation.copy()

    wanted = spin_by_differences(rotations, X)
    kinematics.evaluate(X)
    np.testing.assert_allclose(
        kinematics.station_rotation @ kinematics.station_rotation.transpose(0, 2, 1),
        np.broadcast_to(np.eye(3), kinematics.station_rotation.shape),
        atol=1e-14,
    )
    for face, nodes in enumerate(truss.faces):
        rows = scattered(kinematics.station_spin[face], nodes, truss.node_count)
        np.testing.assert_allclose(rows, wanted[face], atol=5e-9)


@pytest.mark.smoke
def test_tip_spin_is_the_angular_velocity_rows_of_the_tip_frame(truss, kinematics, rng):
    X = random_pose(truss, rng)

    def rotation(Y):
        kinematics.evaluate(Y)
        return kinematics.tip_rotation.copy()

    wanted = spin_by_differences(rotation, X)
    kinematics.evaluate(X)
    assert TrussArm(truss).end_effector.has_frame == (len(truss.tip) >= 3)
    np.testing.assert_allclose(scattered(kinematics.tip_spin, truss.tip, truss.node_count), wanted, atol=5e-9)


def test_everything_is_as_the_equations_say_to_rounding(truss, kinematics, rng):
    """Differences are good to 1e-9; complex steps of the plain equations to the last digits."""
    X = random_pose(truss, rng)
    kinematics.evaluate(X)
    np.testing.assert_allclose(kinematics.quantities, oracle.lengths(truss, X), atol=1e-14)
    rows = np.stack(
        [
            scattered(row.reshape(-1), nodes, truss.node_count)
            for row, nodes in zip(kinematics.gradient, truss.member_nodes, strict=True)
        ]
    )
    wanted = oracle.length_jacobian(truss, X).reshape(truss.member_count, -1)
    np.testing.assert_allclose(rows, wanted, atol=1e-13)
    np.testing.assert_allclose(kinematics.station_rotation, oracle.face_rotations(truss, X), atol=1e-13)
    np.testing.assert_allclose(kinematics.station_spin, oracle.face_spins(truss, X), atol=1e-13)
    np.testing.assert_allclose(kinematics.tip_rotation, oracle.tip_rotation(truss, X), atol=1e-13)
    np.testing.assert_allclose(kinematics.tip_spin, oracle.tip_spin(truss, X), atol=1e-13)
    stations = TrussArm(truss).stations
    np.testing.assert_allclose(stations.centres(X), oracle.face_centres(truss, X), atol=1e-14)


def test_the_rows_of_the_motion_are_the_length_jacobian_beside_the_actuators(truss, kinematics, rng):
    arm, X = TrussArm(truss), random_pose(truss, rng, 0.02)
    kinematics.evaluate(X)
    rows, pattern = kinematics.motion(), arm.motion_pattern
    found = np.zeros((truss.member_count, 3 * len(arm.free) + len(arm.actuators)))
    np.add.at(found, (pattern.rows, pattern.columns), rows.values)
    wanted, _ = oracle.motion(truss, X, X, X)
    np.testing.assert_allclose(found, wanted, atol=1e-13)
    assert [label.kind == "actuated member" for label in pattern.labels] == arm.actuated.tolist()
    rhs = rng.normal(size=truss.member_count)
    response, rest = arm.motion_rows(kinematics.gradient.copy(), rhs).response()
    moved = np.vstack([response, np.eye(len(arm.actuators))])
    np.testing.assert_allclose(wanted @ moved, 0.0, atol=1e-11)
    np.testing.assert_allclose(wanted[:, : len(rest)] @ rest, rhs, atol=1e-10)


def test_a_rigid_motion_keeps_lengths_and_turns_frames_with_it(truss, kinematics, rng):
    X = random_pose(truss, rng)
    turn, shift = Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3)
    kinematics.evaluate(X)
    tip = TrussArm(truss).end_effector
    lengths, faces, tip_rotation = (
        kinematics.quantities.copy(),
        kinematics.station_rotation.copy(),
        kinematics.tip_rotation.copy(),
    )
    gradient, position = kinematics.gradient.copy(), tip.position(X)
    moved = X @ turn.T + shift
    kinematics.evaluate(moved)
    np.testing.assert_allclose(kinematics.quantities, lengths, atol=1e-13)
    np.testing.assert_allclose(kinematics.station_rotation, turn @ faces, atol=1e-12)
    np.testing.assert_allclose(kinematics.gradient, gradient @ turn.T, atol=1e-12)
    np.testing.assert_allclose(tip.position(moved), turn @ position + shift, atol=1e-13)
    if tip.has_frame:
        np.testing.assert_allclose(kinematics.tip_rotation, turn @ tip_rotation, atol=1e-12)


def test_a_face_frame_prefers_no_node(rng):
    """The frame of a scaled, sheared and moved triangle is the same whichever of its nodes is named first."""
    truss = TRUSSES["octahedral"]()
    X = random_pose(truss, rng, 0.2)
    frames = []
    for shift in range(3):
        faces = np.roll(truss.faces, shift, axis=1)
        kinematics = TrussArm(replace(truss, faces=faces)).kinematics(compiled=False)
        kinematics.evaluate(X)
        frames.append(kinematics.station_rotation.copy())
    np.testing.assert_allclose(frames[1], frames[0], atol=1e-12)
    np.testing.assert_allclose(frames[2], frames[0], atol=1e-12)


@pytest.mark.parametrize("offset", OFFSETS)
def test_the_compiled_kernel_is_the_interpreted_one(offset, rng):
    truss = TRUSSES["octahedral"](joint_offset=offset)
    arm = TrussArm(truss)
    compiled, interpreted = arm.kinematics(), arm.kinematics(compiled=False)
    X = random_pose(truss, rng)
    for kinematics in (compiled, interpreted):
        kinematics.evaluate(X)
    for name in ("quantities", "gradient", "station_rotation", "station_spin", "tip_rotation", "tip_spin"):
        np.testing.assert_allclose(getattr(compiled, name), getattr(interpreted, name), atol=1e-13)
