"""Counts, rank and geometry of every module, its joints, and what its faces and tip can do."""

import math
from dataclasses import replace

import numpy as np
import pytest
from modules import double_octahedral, hexapod, longeron, octahedral, tetrahedral

from vgtm_qp.arm.truss.arm import TrussArm
from vgtm_qp.arm.truss.build import build_truss, lock_members
from vgtm_qp.arm.truss.determinacy import check_determinacy, length_jacobian
from vgtm_qp.arm.truss.mobility import describe, tip_response, trackable_coordinates
from vgtm_qp.errors import TrussError, VgtmError
from vgtm_qp.problem.truss import ModuleTruss, TetrahedralTruss

MODULES = {
    "octahedral": octahedral,
    "double-octahedral": double_octahedral,
    "hexapod": hexapod,
    "longeron": longeron,
    "tetrahedral": tetrahedral,
}
# Fixed and actuated members a bay (a double bay for double-octahedral), default stroke over home length.
COUNTS = {
    "octahedral": (6, 3, (0.6, 1.5)),
    "double-octahedral": (15, 3, (0.6, 1.5)),
    "hexapod": (3, 6, (0.7, 1.4)),
    "longeron": (6, 3, (0.6, 1.4)),
    "tetrahedral": (0, 9, (0.75, 1.3)),
}
ROLL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


def node_distances(truss):
    return np.linalg.norm(truss.home[truss.members[:, 0]] - truss.home[truss.members[:, 1]], axis=1)


@pytest.mark.smoke
@pytest.mark.parametrize("bays", range(1, 13))
@pytest.mark.parametrize("module", MODULES)
def test_every_module_is_determinate_in_counts_rank_and_stages(module, bays):
    truss = MODULES[module](bays)
    fixed, actuated, _ = COUNTS[module]
    assert (~truss.actuated).sum() == fixed * bays
    assert truss.actuated.sum() == actuated * bays
    assert truss.member_count == 3 * (truss.node_count - truss.base.sum())
    dense = length_jacobian(truss).toarray()
    assert np.linalg.matrix_rank(dense) == truss.member_count
    values = np.linalg.svd(dense, compute_uv=False)
    report = check_determinacy(truss)
    assert report.rank == report.members == report.coordinates == truss.member_count
    assert report.smallest_singular_value == pytest.approx(values[-1], rel=1e-6)
    assert report.condition == pytest.approx(values[0] / values[-1], rel=1e-3)
    assert_stages_square_and_regular(truss, dense)


def assert_stages_square_and_regular(truss, dense):
    assert set(truss.stage[truss.base]) == {-1}
    assert set(truss.stage[~truss.base]) == set(range(truss.stage.max() + 1))
    row_stage = truss.stage[truss.members].max(axis=1)
    column_stage = np.repeat(truss.stage[truss.free], 3)
    assert np.all(np.diff(column_stage) >= 0)
    assert not dense[row_stage[:, None] < column_stage[None, :]].any()
    for stage in range(truss.stage.max() + 1):
        block = dense[np.ix_(row_stage == stage, column_stage == stage)]
        assert block.shape[0] == block.shape[1]
        assert np.linalg.svd(block, compute_uv=False)[-1] > 0.05


@pytest.mark.parametrize("module", MODULES)
def test_names_are_unique_and_faces_grow_along_z(module):
    truss = MODULES[module](4, longeron=1.1, batten=0.9)
    assert len(set(truss.node_names)) == truss.node_count
    assert len(set(truss.member_names)) == truss.member_count
    assert truss.faces.shape == (5, 3)
    assert truss.base[truss.faces[0]].all()
    assert not truss.base[truss.faces[1:]].any()
    centres = np.einsum("fk,fkc->fc", truss.face_weights, truss.home[truss.faces])
    np.testing.assert_allclose(centres[:, :2], 0.0, atol=1e-12)
    assert centres[0, 2] == pytest.approx(0.0, abs=1e-12)
    steps = np.diff(centres[:, 2])
    np.testing.assert_allclose(steps, steps[0], rtol=1e-12)
    assert steps[0] > 0.5
    assert truss.height == pytest.approx(centres[-1, 2])
    np.testing.assert_array_equal(truss.tip, truss.faces[-1])
    np.testing.assert_allclose(truss.tip_weights @ truss.home[truss.tip], centres[-1], atol=1e-12)
    np.testing.assert_array_equal(truss.face_frames, np.tile(np.eye(3), (5, 1, 1)))
    kinematics = TrussArm(truss).kinematics(compiled=False)
    kinematics.evaluate(truss.home)
    np.testing.assert_allclose(kinematics.station_rotation, truss.face_frames, atol=1e-12)
    np.testing.assert_allclose(kinematics.tip_rotation, truss.tip_frame, atol=1e-12)


@pytest.mark.parametrize("module", MODULES)
def test_home_lengths_and_strokes_are_those_asked_for(module):
    truss = MODULES[module](3, longeron=1.2, batten=0.8)
    kind = np.array([name[0] for name in truss.member_names])
    lengths = node_distances(truss)
    np.testing.assert_allclose(lengths[kind == "L"], 1.2, rtol=1e-12)
    np.testing.assert_allclose(lengths[kind == "B"], 0.8, rtol=1e-12)
    diagonal = 0.8 if module == "tetrahedral" else math.hypot(1.2, 0.8)
    np.testing.assert_allclose(lengths[kind == "D"], diagonal, rtol=1e-12)
    np.testing.assert_allclose(truss.home_lengths, lengths, rtol=1e-12)
    factors = np.where(truss.actuated[:, None], COUNTS[module][2], 1.0)
    np.testing.assert_allclose(truss.stroke, factors * lengths[:, None], rtol=1e-12)


@pytest.mark.parametrize(("side", "batten"), [(1.0, 1.0), (1.3, 0.7), (1.0, 1.65)])
def test_height_of_antiprism_bays_is_the_closed_form(side, batten):
    height = math.sqrt(side**2 - batten**2 / 3)
    assert octahedral(7, longeron=side, batten=batten).height == pytest.approx(7 * height)
    assert hexapod(7, longeron=side, batten=batten).height == pytest.approx(7 * height)
    assert double_octahedral(7, longeron=side, batten=batten).height == pytest.approx(14 * height)


def test_regular_helix_has_the_known_rise_and_weights():
    truss = tetrahedral(5)
    assert truss.height == pytest.approx(5 * 3 / math.sqrt(10))
    np.testing.assert_allclose(truss.face_weights, np.tile([0.3, 0.4, 0.3], (6, 1)))
    radius = np.linalg.norm(truss.home[:, :2], axis=1)
    np.testing.assert_allclose(radius, 3 * math.sqrt(3) / 10)


@pytest.mark.parametrize("module", MODULES)
def test_trackable_coordinates_are_what_the_ranks_say(module):
    truss = MODULES[module](6)
    assert trackable_coordinates(truss) == truss.trackable


@pytest.mark.parametrize("actuated", [(1,), (2,), (3,), (1, 2), (1, 3), (2, 3)])
def test_tetrahedral_actuators_are_a_choice(actuated):
    truss = tetrahedral(6, actuated=actuated)
    assert truss.actuated.sum() == 18 * len(actuated)
    kinds = {name[0] for name, moves in zip(truss.member_names, truss.actuated, strict=True) if moves}
    assert kinds == {"BDL"[k - 1] for k in actuated}
    assert trackable_coordinates(truss) == truss.trackable


def test_longeron_bays_need_two_for_a_pose():
    assert trackable_coordinates(replace(longeron(6), face_stride=1)) == ("position",)


@pytest.mark.parametrize(("bays", "rank"), [(1, 3), (2, 3), (3, 5), (4, 5), (9, 5), (60, 5)])
def test_straight_octahedral_arm_cannot_roll_its_tip(bays, rank):
    truss = octahedral(bays)
    description = describe(truss)
    assert description.tip_rank == rank
    assert len(description.unreachable) == 6 - rank
    assert description.unreachable[0].startswith("roll")
    np.testing.assert_allclose(ROLL @ tip_response(truss), 0.0, atol=1e-9)
    assert "roll" in str(description)


def test_bent_octahedral_arm_rolls_a_little(rng):
    truss = octahedral(6)
    X = truss.home + np.where(truss.base[:, None], 0.0, 0.1 * rng.standard_normal(truss.home.shape))
    assert describe(truss, X).tip_rank == 6


@pytest.mark.parametrize(("module", "bays"), [("hexapod", 1), ("longeron", 2), ("tetrahedral", 1)])
def test_tip_pose_is_free_where_the_module_allows_it(module, bays):
    description = describe(MODULES[module](bays))
    assert (description.tip_rank, description.unreachable) == (6, ())


def test_tip_response_moves_the_tip_as_newton_on_the_lengths_does():
    truss = longeron(4)
    actuator = 7
    step = 1e-6
    lengths = truss.home_lengths.copy()
    lengths[truss.actuators[actuator]] += step
    X = truss.home.copy()
    for _ in range(6):
        ends = truss.member_ends(X)
        error = lengths - np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
        X[truss.free] += np.linalg.solve(length_jacobian(truss, X).toarray(), error).reshape(-1, 3)
    before, after = TrussArm(truss).kinematics(compiled=False), TrussArm(truss).kinematics(compiled=False)
    before.evaluate(truss.home)
    after.evaluate(X)
    turn = (after.tip_rotation @ before.tip_rotation.T - np.eye(3)) / step
    moved = truss.tip_weights @ (X - truss.home)[truss.tip] / step
    response = tip_response(truss)[:, actuator]
    np.testing.assert_allclose(response[:3], moved, atol=1e-4)
    np.testing.assert_allclose(response[3:], [turn[2, 1], turn[0, 2], turn[1, 0]], atol=1e-4)


@pytest.mark.parametrize("module", MODULES)
def test_axial_joint_offsets_shorten_members_and_keep_the_home_jacobian(module, rng):
    pins, joints = MODULES[module](4), MODULES[module](4, joint_offset=0.1)
    np.testing.assert_allclose(joints.home_lengths, node_distances(pins) - 0.2, rtol=1e-12)
    np.testing.assert_allclose(length_jacobian(joints).toarray(), length_jacobian(pins).toarray(), atol=1e-12)
    np.testing.assert_allclose(joints.stroke[~joints.actuated, 0], joints.home_lengths[~joints.actuated])
    X = joints.home + 0.05 * rng.standard_normal(joints.home.shape)
    J, direction = length_jacobian(joints, X), rng.standard_normal(3 * len(joints.free))
    assert np.abs(J - length_jacobian(pins, X)).max() > 1e-3
    difference = np.zeros(joints.member_count)
    for sign in (1.0, -1.0):
        moved = X.copy()
        moved[joints.free] += sign * 1e-6 * direction.reshape(-1, 3)
        ends = joints.member_ends(moved)
        difference += sign * np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) / 2e-6
    np.testing.assert_allclose(J @ direction, difference, atol=1e-7)
    assert_stages_square_and_regular(joints, length_jacobian(joints).toarray())


def test_joint_triangles_are_faces_and_counter_clockwise():
    truss = octahedral(3, joint_offset=0.05)
    corner = truss.home[truss.joints.triangle]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    assert (normal[:, 2] > 0.1).all()
    np.testing.assert_allclose(normal[:, :2], 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: octahedral(0), "bays: found 0; expected an integer from 1"),
        (lambda: octahedral(2, batten=1.8), "where a bay folds flat"),
        (lambda: octahedral(2, longeron=-1.0), "longeron: found -1.0"),
        (lambda: octahedral(2, longeron=math.nan), "longeron: found nan"),
        (lambda: octahedral(2, stroke=[1.1, 1.4]), "holds the home length, 1 m"),
        (lambda: octahedral(2, stroke=[1.4, 0.7]), "least length first"),
        (lambda: octahedral(2, rate=0.0), "rate: found 0"),
        (lambda: octahedral(2, member_radius=-0.1), "member_radius: found -0.1"),
        (lambda: octahedral(2, joint_offset=0.5), "less than half the shortest member"),
        (lambda: tetrahedral(2, actuated=()), "actuated: found"),
        (lambda: tetrahedral(2, actuated=(1, 1)), "one to three different numbers"),
        (lambda: tetrahedral(2, actuated=(1, 4)), "an integer from 1 to 3"),
        (lambda: tetrahedral(2, longeron=1.75), "where the helix folds flat"),
    ],
)
def test_impossible_dimensions_are_refused(build, message):
    with pytest.raises(VgtmError, match=message):
        build()


def test_build_truss_follows_the_table():
    spec = ModuleTruss(
        module="octahedral", bays=3, batten=0.9, stroke=(0.5, 1.2), rate=0.3, member_radius=0.02
    )
    truss = build_truss(spec)
    np.testing.assert_array_equal(truss.stroke[truss.actuated], np.tile([0.5, 1.2], (9, 1)))
    np.testing.assert_array_equal(truss.rate, np.where(truss.actuated, 0.3, np.inf))
    np.testing.assert_array_equal(truss.radius, 0.02)
    for module in ("double-octahedral", "hexapod", "longeron"):
        built = build_truss(ModuleTruss(module=module, bays=2, joint_offset=0.02))
        assert built.module == module
        assert built.joints is not None
    assert build_truss(TetrahedralTruss(module="tetrahedral", bays=2, actuated=(2, 3))).actuated.sum() == 12


def test_locked_members_are_fixed_at_their_length():
    locks = ("B1-2", {"member": "B2-1", "time": 3.0})
    truss = build_truss(ModuleTruss(module="octahedral", bays=3, rate=0.3, joint_offset=0.1, locked=locks))
    locked = truss.member("B1-2")
    assert not truss.actuated[locked]
    np.testing.assert_allclose(truss.stroke[locked], 0.8)
    assert truss.rate[locked] == np.inf
    assert truss.actuated[truss.member("B2-1")]
    assert truss.actuated.sum() == 8
    later = lock_members(truss, ["B2-1"])
    np.testing.assert_allclose(later.stroke[later.member("B2-1")], 0.8)


@pytest.mark.parametrize(
    ("name", "message"),
    [("B9-1", r'locked\[0\]: found "B9-1"; .*did you mean "B'), ("L1-1", "this one has a fixed length")],
)
def test_wrong_locks_are_refused_with_the_choices(name, message):
    with pytest.raises(TrussError, match=message) as caught:
        build_truss(ModuleTruss(module="octahedral", bays=3, locked=(name,)))
    assert "B1-1" in str(caught.value)
