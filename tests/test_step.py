"""Rows of a step's QP against what they linearise, and what the resolver refuses, accepts and reports."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from arms import TRUSSES, arm_problem, central_differences, make_layout, random_pose
from scipy.spatial.transform import Rotation
from steps import drives_nothing

import vgtm_qp as vq
from vgtm_qp.arm.arm import Pose
from vgtm_qp.arm.truss.arm import TrussArm, truss_of
from vgtm_qp.compiled import Kernel
from vgtm_qp.errors import GoalError, ProblemError, VgtmError
from vgtm_qp.geometry import shapes
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.methods import Resolver
from vgtm_qp.qp.full import FullBuilder
from vgtm_qp.qp.linearise import Linearisation
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.rotation import rotation_from_vector, turn_between, vector_from_rotation
from vgtm_qp.rows.clearance import allowed, allowed_function, clearance_rows
from vgtm_qp.step.path import Path
from vgtm_qp.step.step import StepStatus
from vgtm_qp.step.target import QPInput, Target
from vgtm_qp.step.task import TipTask

FRAMED = [name for name in TRUSSES if name != "graph"]


def lengths_at(truss, X):
    ends = truss.member_ends(X)
    return np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)


class Scene:
    """A truss at a random pose beside a random curve, and a path through the tip's pose there."""

    def __init__(self, name, track, rng, joint_offset=0.0, base=False):
        self.truss = truss = TRUSSES[name](joint_offset=joint_offset)
        self.layout, self.task = make_layout(truss, track)
        self.arm = self.layout.arm
        self.kinematics = self.arm.kinematics(compiled=False)
        self.X = random_pose(truss, rng, 0.04)
        self.kinematics.evaluate(self.X)
        position = self.arm.end_effector.position(self.X)
        rotation = self.kinematics.tip_rotation.copy()
        axis = np.array([0.0, 0.0, truss.height])
        self.vertices = np.linspace(0, 1, 5)[:, None] * axis + 0.1 * rng.normal(size=(5, 3))
        self.progress = 0.4
        move, turn = 0.3 * rng.normal(size=3), 0.3 * rng.normal(size=3)
        if "pointing" in track:
            turn -= rotation[:, 2] * (rotation[:, 2] @ turn)
        back, on = (Rotation.from_rotvec(share * turn).as_matrix() @ rotation for share in (-0.4, 0.6))
        self.path = Path(
            np.array([0.0, 2.0]),
            np.stack([position - 0.4 * move, position + 0.6 * move]),
            np.stack([back, on]),
        )
        lengths = self.kinematics.quantities[truss.actuators]
        pose = Pose(0.01 * rng.normal(size=3), rotation_from_vector(0.01 * rng.normal(size=3)))
        self.target = Target(
            self.path,
            0.0,
            2.0,
            lengths - 0.1,
            lengths + 0.2,
            time=1.0,
            duration=1.0,
            base=pose if base else None,
        )
        self.linearisation = Linearisation(self.layout, compiled=False)

    def numbers(self, motion=True):
        asked = QPInput(
            self.X,
            self.X,
            self.vertices,
            np.zeros(0),
            self.target,
            self.target.goal(self.progress),
            self.progress,
            ClearanceRows(),
            motion,
        )
        return self.linearisation.numbers(asked.linear(self.layout), asked.rows)

    def residual(self, X, vertices, progress, axes0, across0):
        """What each row of the QP is the linearisation of, by other formulas."""
        truss, layout = self.truss, self.layout
        lengths = lengths_at(truss, X)
        self.kinematics.evaluate(X)
        faces, tip = self.kinematics.station_rotation.copy(), self.kinematics.tip_rotation.copy()
        goal = self.path.at(2.0 * progress)
        error = (truss.tip_weights @ X[truss.tip] - goal.position)[self.task.axes]
        if self.task.turns == "pointing":
            error = np.concatenate([error, across0 @ turn_between(goal.rotation[:, 2], tip[:, 2])])
        elif self.task.turns == "orientation":
            error = np.concatenate([error, vector_from_rotation(tip @ goal.rotation.T)])
        centres = np.einsum("fk,fkc->fc", truss.face_weights, X[truss.faces])
        slopes = layout.curve_slopes @ vertices
        tangents = slopes / np.linalg.norm(slopes, axis=1, keepdims=True)
        tilt = np.einsum("kca,kc->ka", faces[layout.tracked][:, :, :2], tangents)
        gap = centres[layout.tracked] - layout.curve_weights @ vertices
        start = vertices[0] - (centres[0] if self.target.base is None else 0.0)
        return [lengths, error, start, axes0 @ (vertices[1] - vertices[0]), gap, tilt]


@pytest.mark.smoke
@pytest.mark.parametrize("joint_offset", [0.0, 0.1])
@pytest.mark.parametrize(
    ("name", "track"),
    [(name, ("position", "pointing")) for name in FRAMED]
    + [("hexapod", ("position", "orientation")), ("octahedral", ("x", "z")), ("octahedral", ("orientation",))]
    + [("graph", ("position",)), ("graph", ("y",))],
)
def test_rows_of_the_full_qp_linearise_what_they_say(name, track, joint_offset, rng):
    """The rows at a random displacement against the change of the residuals themselves."""
    scene = Scene(name, track, rng, joint_offset)
    numbers = scene.numbers()
    builder = FullBuilder(scene.layout)
    qp = builder.build(numbers)
    truss, tracked = scene.truss, len(scene.layout.tracked)
    node_step = np.where(truss.base[:, None], 0.0, rng.normal(size=scene.X.shape))
    vertex_step, progress_step = rng.normal(size=scene.vertices.shape), 0.5

    def moved(h):
        return scene.residual(
            scene.X + h * node_step,
            scene.vertices + h * vertex_step,
            scene.progress + h * progress_step,
            axes0,
            across0,
        )

    scene.kinematics.evaluate(scene.X)
    axes0 = scene.kinematics.station_rotation[0][:, :2].T.copy()
    across0 = scene.kinematics.tip_rotation[:, :2].T.copy()
    h = 1e-6
    change = [(a - b) / (2 * h) for a, b in zip(moved(h), moved(-h), strict=True)]
    lengths, error, start, slope, gap, tilt = change
    z = np.zeros(builder.size)
    z[builder.column["nodes"]] = node_step[truss.free].reshape(-1)
    z[builder.column["actuators"]] = lengths[truss.actuators]
    z[builder.column["vertices"]] = vertex_step.reshape(-1)
    z[builder.column["position"]] = gap.reshape(-1)
    z[builder.column["tangent"]] = tilt.reshape(-1)
    z[-1] = progress_step
    wanted = np.where(truss.actuated, 0.0, lengths)
    # A leg grows by what its ends move along it.
    legs = np.diff(vertex_step, axis=0)[scene.layout.legs[:, 0]]
    normal = (
        scene.kinematics.station_rotation[0][:, 2] if scene.target.base is None else numbers.legs.rows[0, 3:6]
    )
    last = np.diff(scene.vertices, axis=0)[-1]
    axes = np.array([normal, last / np.linalg.norm(last)])[: len(legs)]
    grown = np.einsum("gc,gc->g", axes, legs)
    parts = [wanted, error, start, slope, np.zeros(3 * tracked), np.zeros(2 * tracked), grown]
    np.testing.assert_allclose(qp.A @ z, np.concatenate(parts), atol=2e-8)


@pytest.mark.parametrize("name", ["octahedral", "tetrahedral-23", "hexapod"])
def test_right_hand_sides_are_the_residuals(name, rng):
    """At the configuration itself: a step to no displacement leaves each residual as it is."""
    scene = Scene(name, ("position", "pointing"), rng)
    numbers = scene.numbers()
    scene.kinematics.evaluate(scene.X)
    axes0 = scene.kinematics.station_rotation[0][:, :2].T.copy()
    across0 = scene.kinematics.tip_rotation[:, :2].T.copy()
    lengths, error, start, slope, gap, tilt = scene.residual(scene.X, scene.vertices, 0.4, axes0, across0)
    truss = scene.truss
    fixed, actuators = ~truss.actuated, truss.actuators
    np.testing.assert_allclose(numbers.motion.rhs[fixed], (truss.home_lengths - lengths)[fixed], atol=1e-13)
    np.testing.assert_array_equal(numbers.motion.rhs[actuators], 0.0)
    np.testing.assert_allclose(numbers.lower + lengths[actuators], scene.target.lower, atol=1e-13)
    np.testing.assert_allclose(numbers.upper + lengths[actuators], scene.target.upper, atol=1e-13)
    np.testing.assert_allclose(numbers.tip_rhs, -error, atol=1e-12)
    np.testing.assert_allclose(numbers.base_displacement, -start, atol=1e-13)
    np.testing.assert_allclose(numbers.base_rhs, -slope, atol=1e-13)
    np.testing.assert_allclose(numbers.position_rhs, gap, atol=1e-13)
    np.testing.assert_allclose(numbers.tangent_rhs, tilt, atol=1e-13)
    assert numbers.progress_lower == pytest.approx(-0.4)
    assert numbers.progress_upper == pytest.approx(0.6)
    weights = scene.layout.weights
    np.testing.assert_allclose(
        numbers.actuator_gradient,
        weights.stroke_centring * (lengths - truss.home_lengths)[actuators],
        atol=1e-14,
    )
    polygon = np.diff(scene.vertices, n=2, axis=0)
    gradient = central_differences(
        lambda p: np.array(0.5 * weights.smoothness * np.sum(np.diff(p, n=2, axis=0) ** 2)), scene.vertices
    )
    np.testing.assert_allclose(numbers.vertex_gradient, gradient, atol=1e-9)
    assert np.linalg.norm(polygon) > 0.1


def test_a_correction_asks_for_the_constraints_alone(rng):
    scene = Scene("octahedral", ("position",), rng)
    motion, correction = scene.numbers(), scene.numbers(motion=False)
    for name in ("actuator_gradient", "vertex_gradient", "position_rhs", "tangent_rhs"):
        assert np.any(getattr(motion, name))
        # The curve's end is a constraint.
        asked = getattr(correction, name)[:-1] if name == "position_rhs" else getattr(correction, name)
        assert not np.any(asked), name
    np.testing.assert_allclose(correction.position_rhs[-1], motion.position_rhs[-1], atol=1e-13)
    np.testing.assert_allclose(correction.motion.rhs, motion.motion.rhs, atol=1e-13)
    np.testing.assert_allclose(correction.motion.values, motion.motion.values, atol=1e-13)
    for name in ("tip_rhs", "base_rhs", "base_displacement", "tip_jacobian", "tangent_face"):
        np.testing.assert_allclose(getattr(correction, name), getattr(motion, name), atol=1e-13)


def test_a_moving_base_takes_its_members_and_the_curve_with_it(rng):
    scene = Scene("octahedral", ("position",), rng, base=True)
    numbers = scene.numbers()
    truss, pose = scene.truss, scene.target.base
    base = truss.home @ pose.rotation.T + pose.position
    moved = np.where(truss.base[:, None], base, scene.X)
    h = 1e-6
    ahead, behind = (lengths_at(truss, scene.X + s * h * (moved - scene.X)) for s in (1.0, -1.0))
    rate = (ahead - behind) / (2 * h)
    error = np.where(truss.actuated, 0.0, truss.home_lengths - lengths_at(truss, scene.X))
    np.testing.assert_allclose(numbers.motion.rhs, error - rate, atol=1e-8)
    centre = truss.face_weights[0] @ base[truss.faces[0]]
    np.testing.assert_allclose(scene.vertices[0] + numbers.base_displacement, centre, atol=1e-13)
    scene.kinematics.evaluate(scene.X)
    axes = scene.kinematics.station_rotation[0][:, :2].T.copy()
    scene.kinematics.evaluate(moved)
    turned = scene.kinematics.station_rotation[0][:, :2].T
    assert np.abs(turned - axes).max() > 1e-3
    np.testing.assert_allclose(numbers.base_axes, turned, atol=1e-13)


def obstacles():
    turn = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
    return [
        shapes.box("crate", [0.9, 0.3, 1.0], [0.5, 0.4, 0.7], turn),
        shapes.sphere("ball", [-0.8, 0.5, 0.6], 0.3),
        shapes.cylinder("drum", [0.1, -1.0, 1.4], 0.25, 0.6, turn),
    ]


def pair_distance(monitor, member, other, is_self, X):
    """The exact surface distance of one pair, by asking for all near pairs."""
    pairs = monitor.near(X, 0.0, 3.0, self_reach=3.0)
    chosen = (pairs.body == member) & (pairs.other == other) & (pairs.is_self == is_self)
    return float(np.min(pairs.distance[chosen]))


@pytest.mark.smoke
@pytest.mark.parametrize("fraction", [1.0, 0.35])
@pytest.mark.parametrize("name", ["octahedral", "tetrahedral-123"])
def test_clearance_rows_are_the_derivatives_of_the_exact_distances(name, fraction, rng):
    """Rows found at a `fraction` of the way from a state, against displacements of the end of that way."""
    truss = TRUSSES[name](member_radius=0.02)
    state, end = random_pose(truss, rng, 0.03), random_pose(truss, rng, 0.03)
    monitor = Clearance(TrussArm(truss).bodies, obstacles(), safe=0.05, influence=0.6)
    safe, self_safe = 0.07, 0.03

    def between(X):
        return state + fraction * (X - state)

    pairs = monitor.near(between(end), 0.0, 0.6, self_reach=1.0)
    coefficients, lower = clearance_rows(
        pairs.distance, pairs.normal, pairs.weights, pairs.is_self, safe, self_safe, fraction=fraction
    )
    assert len(lower) == len(pairs) > 10
    assert pairs.is_self.any()
    assert (~pairs.is_self).any()
    floor = np.where(pairs.is_self, self_safe, safe)
    np.testing.assert_allclose(lower, floor - pairs.distance, atol=1e-14)
    compared = 0
    for k in range(len(lower)):
        member, other, is_self = int(pairs.body[k]), int(pairs.other[k]), bool(pairs.is_self[k])
        if np.sum((pairs.body == member) & (pairs.other == other) & (pairs.is_self == is_self)) > 1:
            continue
        gradient = np.zeros_like(end)
        np.add.at(gradient, pairs.points[k], coefficients[k])
        step = rng.normal(size=end.shape)
        h = 1e-6
        here = pair_distance(monitor, member, other, is_self, between(end))
        ahead, behind = (
            pair_distance(monitor, member, other, is_self, between(end + s * h * step)) for s in (1.0, -1.0)
        )
        assert here == pytest.approx(float(pairs.distance[k]), abs=1e-12)
        smooth = abs((ahead - here) - (here - behind)) < 1e-9
        if smooth:
            compared += 1
            assert float(np.sum(gradient * step)) == pytest.approx((ahead - behind) / (2 * h), abs=2e-5), (
                pairs.name(k)
            )
    assert compared > 0.6 * len(lower)


def test_arrays_and_c_have_the_same_bounds_of_a_step(rng):
    """A pair that is far, near or too near; without a cap where it is driven apart."""
    given = rng.normal(size=(5, 60))
    given[1:4] = np.abs(given[1]), 0.1 * given[2], rng.choice([0.4, 1.0], 60)
    given[1, ::7], given[4] = np.inf, 0.1 * np.abs(given[4])
    kernel, expected = Kernel(allowed_function()), []
    for column, found in zip(given.T, allowed(*given), strict=True):
        missing, most, nearer, share, least = column
        lower = min(missing, most) + nearer
        # A clearance that remains may be used up to a share or `least`; one that is missing is asked for.
        wanted = lower if lower >= -least else min(-least, share * lower)
        for argument, value in zip(kernel.inputs, column, strict=True):
            argument[:] = value
        kernel()
        assert found == pytest.approx(wanted, abs=1e-15)
        assert kernel.outputs[0][0] == found
        expected.append(wanted)
    assert min(expected) < 0.0 < max(expected)


def test_joined_clearance_rows_keep_their_names():
    first = ClearanceRows(np.zeros((2, 4), int), np.zeros((2, 4, 3)), np.zeros(2), lambda k: f"a{k}")
    second = ClearanceRows(np.zeros((3, 4), int), np.zeros((3, 4, 3)), np.ones(3), lambda k: f"b{k}")
    joined = first.joined(second).joined(first)
    assert [joined.name(k) for k in range(len(joined))] == ["a0", "a1", "b0", "b1", "b2", "a0", "a1"]


def test_the_end_effector_says_what_it_cannot_track():
    arm = TrussArm(TRUSSES["graph"]())
    with pytest.raises(GoalError, match="three or more nodes; this one has 1"):
        TipTask(("position", "pointing"), arm)
    arm = TrussArm(TRUSSES["hexapod"]())
    with pytest.raises(
        GoalError, match=r'cannot track "poistion"; did you mean "position".*choices: position'
    ):
        TipTask(("poistion",), arm)
    for track in (("position", "x"), ("pointing", "orientation"), ("z", "z")):
        with pytest.raises(GoalError, match="twice"):
            TipTask(track, arm)


# The resolver


@pytest.fixture(scope="module")
def crate_problem():
    """Two bays beside a crate that the tip's way leads past."""
    return arm_problem(
        (0.75, 0.25, 1.35),
        steps=12,
        time=6.0,
        truss={"rate": 0.4, "acceleration": 0.6, "member_radius": 0.02},
        obstacle=[{"name": "crate", "shape": "box", "center": [1.15, 0.0, 1.0], "size": [0.3, 1.0, 0.5]}],
        clearance={"safe": 0.05, "influence": 0.4, "self_safe": 0.01},
    )


def snapshot(state):
    kept = {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}
    kept["tip"] = () if state.tip is None else np.concatenate([state.tip.position[None], state.tip.rotation])
    return {name: np.copy(value) for name, value in kept.items()}


def assert_same(state, kept):
    for name, value in snapshot(state).items():
        np.testing.assert_array_equal(kept[name], value, err_msg=name)


WRONG_GOALS = [
    {"position": [np.nan, 0.0, 1.0]},
    {"position": [0.0, np.inf, 1.0]},
    {"position": [0.0, 1.0]},
    {"position": [[0.0, 1.0, 2.0]]},
    {"position": "up"},
    {"position": [0.0, [1.0], 2.0]},
    {"position": 1.0},
    {"position": {"x": 1.0}},
    {"pointing": [0.0, 0.0, 1.0]},
    {"rotation_vector": [0.0, 0.0, 0.1]},
    {"position": [0.1, 0.0, 1.6], "dt": 0.0},
    {"position": [0.1, 0.0, 1.6], "dt": -1.0},
    {"position": [0.1, 0.0, 1.6], "dt": np.nan},
    {"position": [0.1, 0.0, 1.6], "dt": np.inf},
]


@pytest.mark.smoke
@pytest.mark.parametrize("goal", WRONG_GOALS, ids=str)
def test_a_goal_that_is_no_goal_is_refused_and_nothing_moves(crate_problem, goal):
    resolver = Resolver(crate_problem)
    resolver.step(position=[0.1, 0.0, 1.6])
    before, kept = resolver.state, snapshot(resolver.state)
    with pytest.raises(GoalError, match="unchanged"):
        resolver.step(**goal)
    assert resolver.state is before
    assert_same(resolver.state, kept)
    assert resolver.step(position=[0.12, 0.0, 1.6]).status is StepStatus.REACHED


@pytest.mark.parametrize(
    "goal",
    [
        {"pointing": [0.0, 0.0, 0.0]},
        {"pointing": [0.0, np.nan, 1.0]},
        {"pointing": [0.0, 1.0]},
        {"rotation_vector": [np.inf, 0.0, 0.0]},
        {"position": [0.0, 0.0, 1.6]},
        {"pointing": [0.0, 0.1, 1.0], "rotation_vector": [0.1, 0.0, 0.0]},
    ],
    ids=str,
)
def test_a_direction_that_is_none_is_refused(goal):
    problem = arm_problem(
        truss={"module": "hexapod", "stroke": [0.7, 1.4]},
        waypoint={"pointing": [0.0, 0.2, 1.0], "position": None},
        end_effector={"track": ["pointing"]},
    )
    resolver = Resolver(problem)
    before = resolver.state
    with pytest.raises(GoalError, match="unchanged"):
        resolver.step(**goal)
    assert resolver.state is before


def test_states_cannot_be_changed(crate_problem):
    resolver = Resolver(crate_problem)
    step = resolver.step(position=[0.1, 0.0, 1.6])
    for state in (resolver.state, step.state, Resolver(resolver.setup).state):
        for field in dataclasses.fields(state):
            with pytest.raises(dataclasses.FrozenInstanceError):
                setattr(state, field.name, None)
            value = getattr(state, field.name)
            if isinstance(value, np.ndarray):
                with pytest.raises(ValueError, match="read-only"):
                    value[...] = 0.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        step.status = StepStatus.REACHED


def test_a_state_does_not_share_memory_with_the_next_steps(crate_problem):
    resolver = Resolver(crate_problem)
    first = resolver.step(position=[0.1, 0.0, 1.6]).state
    kept = snapshot(first)
    for x in (0.12, 0.15, 0.2):
        resolver.step(position=[x, 0.0, 1.6])
    assert_same(first, kept)


def walk(resolver, targets, dt=None):
    """Steps towards targets, each with the state before it."""
    for target in targets:
        before = resolver.state
        yield before, target, resolver.step(position=target, dt=dt)


def check_step(resolver, before, target, step, dt):
    """Recompute from the nodes alone everything that an accepted step has to keep."""
    truss, state = truss_of(resolver.setup.arm), step.state
    if step.status is StepStatus.BLOCKED:
        assert step.state is before
        assert resolver.state is before
        assert step.progress == 0.0
        assert step.blocked_by
        return
    if step.braked:
        # It was proven before its time, for steps of the duration at that time, on the path of that time.
        dt = state.duration
    assert resolver.state is state
    lengths, lengths_before = lengths_at(truss, state.nodes), lengths_at(truss, before.nodes)
    np.testing.assert_allclose(state.quantities, lengths, atol=1e-13)
    np.testing.assert_array_equal(state.nodes[truss.base], truss.home[truss.base])
    fixed = ~truss.actuated
    assert np.max(np.abs(lengths - truss.home_lengths)[fixed], initial=0.0) <= 1e-9
    stroke = np.maximum(truss.stroke[:, 0] - lengths, lengths - truss.stroke[:, 1])[truss.actuated]
    assert np.max(stroke) <= 1e-9
    rate = (lengths - lengths_before) / dt
    np.testing.assert_allclose(state.rates, rate, atol=1e-12 / dt)
    assert np.max((np.abs(rate) - truss.rate)[truss.actuated]) <= 1e-9
    if before.time > 0.0:
        interval = 0.5 * (dt + before.duration)
        acceleration = np.abs(rate - before.rates) / interval
        assert np.max((acceleration - truss.acceleration)[truss.actuated]) <= 1e-9
    assert state.time == pytest.approx(before.time + dt)
    start = truss.tip_weights @ before.nodes[truss.tip]
    tip = truss.tip_weights @ state.nodes[truss.tip]
    wanted = start + step.progress * (np.asarray(target) - start)
    if not step.braked:
        np.testing.assert_allclose(tip[resolver.setup.task.axes], wanted[resolver.setup.task.axes], atol=1e-6)
    assert (step.status is StepStatus.REACHED) == (step.progress >= 1.0 - 1e-9)
    assert 0.0 <= step.progress <= 1.0


def targets_to(goal, start, count):
    return [start + (goal - start) * k / count for k in range(1, count + 1)]


@pytest.mark.parametrize("dt", [0.5, 0.02])
def test_accepted_steps_keep_every_limit_by_recomputation(crate_problem, dt):
    """Towards and then into the crate, by steps of a maneuver and of a control loop."""
    resolver = Resolver(crate_problem)
    start, goal = resolver.tip()[0], np.array([1.05, 0.0, 1.25])
    statuses = set()
    fresh = Resolver(crate_problem).setup.monitor
    for before, target, step in walk(resolver, targets_to(goal, start, 14 if dt > 0.1 else 60), dt):
        check_step(resolver, before, target, step, dt)
        statuses.add(step.status)
        assert fresh.least(step.state.nodes, among="obstacles")[0] >= 0.05 - 1e-9
        assert fresh.least(step.state.nodes, among="members")[0] >= 0.01 - 1e-9
        assert fresh.along(
            np.stack([before.nodes, step.state.nodes]), 0.0, 0.0, 0.05 - 1e-4, 0.01 - 1e-4
        ).certified
    assert StepStatus.SLOWED in statuses


@pytest.mark.parametrize("solver", ["daqp", "piqp"])
@pytest.mark.parametrize("dt", [0.2, 0.02, 0.002])
def test_random_goals_keep_rate_and_acceleration_at_any_duration(solver, dt, rng):
    """An error in a length counts the more in a rate and an acceleration the shorter the step is."""
    problem = arm_problem(bays=3, truss={"rate": 0.3, "acceleration": 0.6}, method={"solver": solver})
    resolver = Resolver(problem)
    moved = 0
    for _ in range(15):
        before = resolver.state
        target = resolver.tip()[0] + dt * (0.3 * rng.normal(size=3) + [0.5, 0.0, -0.3])
        step = resolver.step(position=target, dt=dt)
        check_step(resolver, before, target, step, dt)
        moved += step.status is not StepStatus.BLOCKED
    assert moved >= 5


def test_durations_may_differ_from_step_to_step(crate_problem, rng):
    resolver = Resolver(crate_problem)
    start = resolver.tip()[0]
    for k in range(20):
        dt = float(rng.choice([0.1, 0.2, 0.35]))
        before, target = resolver.state, start + np.array([0.02 * k, 0.005 * k, -0.004 * k])
        check_step(resolver, before, target, resolver.step(position=target, dt=dt), dt)
    assert resolver.tip()[0][0] > 0.1


@pytest.mark.parametrize("name", ["double-octahedral", "hexapod", "longeron", "tetrahedral"])
def test_every_module_moves_by_the_resolver(name):
    problem = arm_problem((0.2, 0.1, 1.0), truss={"module": name, "stroke": None, "joint_offset": 0.05})
    resolver = Resolver(problem)
    start = resolver.tip()[0]
    goal = start + np.array([0.12, 0.05, -0.05]) * resolver.setup.arm.height
    for before, target, step in walk(resolver, targets_to(goal, start, 4), 1.0):
        check_step(resolver, before, target, step, 1.0)
        assert step.status is StepStatus.REACHED


@pytest.mark.parametrize(
    ("module", "tracking"), [("octahedral", "none"), ("octahedral", "coupled"), ("graph", "coupled")]
)
def test_trusses_with_and_without_a_curve_move(module, tracking):
    if module == "graph":
        truss = graph_table()
        problem = arm_problem((0.2, 0.1, 1.0), truss=truss, method={"tracking": tracking})
    else:
        problem = arm_problem((0.2, 0.1, 1.0), method={"tracking": tracking})
    resolver = Resolver(problem)
    assert len(resolver.state.control_vertices) == (0 if tracking == "none" else 6)
    start = resolver.tip()[0]
    goal = start + np.array([0.1, 0.05, -0.05])
    for before, target, step in walk(resolver, targets_to(goal, start, 3), 1.0):
        check_step(resolver, before, target, step, 1.0)
        assert step.status is StepStatus.REACHED


def graph_table():
    mast = TRUSSES["graph"]()
    names = mast.node_names
    return {
        "module": "graph",
        "bays": None,
        "stroke": [0.3, 3.0],
        "node": [
            {"name": n, "position": p.tolist(), "fixed": bool(b)}
            for n, p, b in zip(names, mast.home, mast.base, strict=True)
        ],
        "member": [
            {"name": n, "nodes": [names[i] for i in pair], "actuated": bool(a)}
            for n, pair, a in zip(mast.member_names, mast.members, mast.actuated, strict=True)
        ],
        "tip": ["top"],
        "faces": [[names[i] for i in face] for face in mast.faces],
    }


def test_blocked_says_why_and_leaves_the_state(crate_problem):
    """Into the middle of the crate: the arm stops before it and names it."""
    resolver = Resolver(crate_problem)
    goal = np.array([1.15, 0.0, 1.0])
    last = None
    for _ in range(40):
        before, kept = resolver.state, snapshot(resolver.state)
        step = resolver.step(position=goal)
        if step.status is StepStatus.BLOCKED or step.progress < 1e-3:
            last = step
            break
    assert last is not None
    assert any("crate" in name for name in last.blocked_by), last.blocked_by
    assert any("crate" in name for name in last.active)
    assert str(last).startswith(f"{last.status}: ")
    assert f"held by {last.blocked_by[0]}" in str(last)
    assert "\n" not in repr(last)
    assert "array" not in repr(last)
    if last.status is StepStatus.BLOCKED:
        assert resolver.state is before
        assert_same(resolver.state, kept)


def test_active_rows_are_named_with_their_multipliers(crate_problem):
    resolver = Resolver(crate_problem)
    start, goal = resolver.tip()[0], np.array([1.05, 0.0, 1.25])
    members = set(resolver.setup.arm.quantity_names)
    seen = set()
    for _, _, step in walk(resolver, targets_to(goal, start, 14), 0.5):
        assert set(step.active) == set(step.multipliers)
        assert all(value > 0.0 for value in step.multipliers.values())
        values = [step.multipliers[name] for name in step.active]
        assert values == sorted(values, reverse=True)
        for name in step.active:
            kind, _, what = name.partition(": ")
            seen.add(kind)
            if kind == "clearance":
                first, other = what.removeprefix("member ").split(" / ")
                assert first in members
                assert other == "crate" or other.removeprefix("member ") in members
            else:
                assert what in members
    assert "clearance" in seen


def test_a_locked_or_limiting_actuator_is_named():
    problem = arm_problem((0.5, 0.0, 1.0), truss={"rate": 0.01})
    step = Resolver(problem).step(position=[0.5, 0.0, 1.3], dt=1.0)
    assert step.status is StepStatus.SLOWED
    assert any(name.endswith(("B1-1", "B1-2", "B1-3", "B2-1", "B2-2", "B2-3")) for name in step.active), (
        step.active
    )


def test_calls_are_deterministic(crate_problem):
    runs = []
    for _ in range(2):
        resolver = Resolver(crate_problem)
        start, goal = resolver.tip()[0], np.array([1.0, 0.1, 1.25])
        runs.append(
            [(step, snapshot(step.state)) for _, _, step in walk(resolver, targets_to(goal, start, 10))]
        )
    for (first, kept), (second, _) in zip(*runs, strict=True):
        assert (first.status, first.progress, first.active, first.qps) == (
            second.status,
            second.progress,
            second.active,
            second.qps,
        )
        assert_same(second.state, kept)


def test_two_resolvers_on_one_arm_do_not_disturb_each_other(crate_problem):
    alone = Resolver(crate_problem)
    first = Resolver(alone.setup)
    second = Resolver(alone.setup)
    fresh = Resolver(crate_problem)
    start = fresh.tip()[0]
    for k in range(1, 6):
        wanted = start + k * np.array([0.04, 0.01, -0.01])
        other = start - k * np.array([0.03, 0.02, 0.02])
        one = first.step(position=wanted)
        second.step(position=other)
        np.testing.assert_allclose(fresh.step(position=wanted).state.nodes, one.state.nodes, atol=1e-9)
        np.testing.assert_allclose(first.tip()[0], fresh.tip()[0], atol=1e-9)


def test_staying_where_it_is_is_a_step_too(crate_problem):
    resolver = Resolver(crate_problem)
    here = resolver.tip()[0]
    step = resolver.step()
    assert step.status is StepStatus.REACHED
    np.testing.assert_allclose(resolver.tip()[0], here, atol=1e-8)


@pytest.mark.parametrize("solver", ["daqp", "piqp"])
@pytest.mark.parametrize("way", [1e-3, 1e-5, 2e-6, 5e-7, 1e-9])
def test_a_short_way_is_covered_as_surely_as_a_long_one(solver, way):
    """What pulls in the null space must not outweigh progress, however little there is left to go."""
    resolver = Resolver(arm_problem(bays=3, method={"solver": solver}))
    start = resolver.tip()[0]
    for target in targets_to(np.array([0.7, 0.2, 1.9]), start, 4):
        resolver.step(position=target)
    for direction in np.vstack([np.eye(3), -np.eye(3)]):
        goal = resolver.tip()[0] + way * direction
        assert resolver.step(position=goal).status is StepStatus.REACHED
        np.testing.assert_allclose(resolver.tip()[0], goal, atol=2e-8)


def test_a_solver_that_fails_is_what_stops_the_maneuver(crate_problem, monkeypatch):
    import qpsolvers

    solve, left = qpsolvers.solve_problem, []

    def spoilt(problem, **options):
        answer = solve(problem, **options)
        if len(left) >= 3:
            answer.x = answer.x + 1e-3
        x = answer.x
        beyond = np.concatenate([problem.G @ x - problem.h, problem.lb - x, x - problem.ub])
        off = np.concatenate([problem.A @ x - problem.b, np.maximum(beyond, 0.0)])
        left.append(float(np.linalg.norm(off)))
        return answer

    monkeypatch.setattr(qpsolvers, "solve_problem", spoilt)
    maneuver = vq.solve(crate_problem.replace({"method.solver": "clarabel", "method.retries": False}))
    stop = maneuver.manifest["stop"]
    assert 0.0 < maneuver.reached < 1.0
    assert (maneuver.status, stop["kind"]) == ("blocked", "solver")
    assert maneuver.blocked_by == (f"solver: {stop['reason']}",)
    assert min(left[3:]) > 1e-3
    assert any(f"primal residual of {off:.1e} m" in stop["reason"] for off in left[3:]), (stop, left)


def test_a_solver_that_finds_nothing_where_there_is_a_way_is_what_stops_the_maneuver(
    crate_problem, monkeypatch
):
    import qpsolvers

    monkeypatch.setattr(
        qpsolvers, "solve_problem", lambda problem, **_: qpsolvers.Solution(problem, found=False)
    )
    maneuver = vq.solve(crate_problem.replace({"method.solver": "clarabel", "method.retries": False}))
    assert maneuver.blocked_by == ("solver: clarabel found no solution",)


def test_a_solver_that_fails_blocks_the_step_and_leaves_the_state(crate_problem, monkeypatch):
    import qpsolvers

    resolver = Resolver(crate_problem.replace({"method.solver": "clarabel"}))
    resolver.step(position=[0.1, 0.0, 1.6])
    before, kept = resolver.state, snapshot(resolver.state)
    solve = qpsolvers.solve_problem

    def spoilt(problem, **options):
        answer = solve(problem, **options)
        answer.x = answer.x + 1e-3
        return answer

    monkeypatch.setattr(qpsolvers, "solve_problem", spoilt)
    step = resolver.step(position=[0.2, 0.0, 1.6])
    assert step.status is StepStatus.BLOCKED
    assert "residual" in step.reason
    assert resolver.state is before
    assert_same(resolver.state, kept)
    monkeypatch.undo()
    assert resolver.step(position=[0.12, 0.0, 1.6]).status is StepStatus.REACHED


@pytest.mark.parametrize("solver", ["osqp", "piqp", "clarabel"])
def test_steps_do_not_depend_on_the_solver(crate_problem, solver):
    default, other = Resolver(crate_problem), Resolver(crate_problem.replace({"method.solver": solver}))
    start, goal = default.tip()[0], np.array([0.65, 0.07, 1.4])
    active = set()
    for target in targets_to(goal, start, 6):
        wanted, found = default.step(position=target), other.step(position=target)
        assert found.status is wanted.status
        assert found.progress == pytest.approx(wanted.progress, abs=1e-4)
        np.testing.assert_allclose(found.state.nodes, wanted.state.nodes, atol=1e-4)
        np.testing.assert_allclose(found.state.control_vertices, wanted.state.control_vertices, atol=1e-4)
        active.update(wanted.active)
    assert any("crate" in name for name in active)


def test_an_unknown_solver_is_refused_with_its_place(crate_problem):
    with pytest.raises(ProblemError, match=r'method\.solver: found "osq"; .*did you mean "osqp"'):
        Resolver(crate_problem.replace({"method.solver": "osq"}))
    assert issubclass(ProblemError, VgtmError)


@pytest.mark.parametrize("dt", ["soon", np.nan, np.inf, 0.0, -1.0, 1e300, 1e-300])
def test_a_duration_that_is_none_is_refused(dt):
    resolver = Resolver(arm_problem(bays=2))
    before = resolver.state
    with pytest.raises(vq.GoalError, match="dt must be a positive number of seconds"):
        resolver.step(position=[0.0, 0.0, 1.5], dt=dt)
    assert resolver.state is before


def test_a_state_of_another_curve_is_refused():
    resolver = Resolver(arm_problem(bays=3))
    before = resolver.state
    resolver.set_control_vertices(len(before.control_vertices) + 2)
    with pytest.raises(vq.GoalError, match="control vertices; the arm has"):
        resolver.state = before


def crowded(resolver, count):
    """A QP of the resolver's engine with so many clearance rows that hold nothing."""
    setup, state = resolver.setup, resolver.state
    tip, rotation = resolver.tip()
    path = Path(np.array([0.0, 1.0]), np.stack([tip, tip + 0.001]), np.stack([rotation, rotation]))
    strokes = state.quantities[setup.arm.actuators]
    target = Target(path, 0.0, 1.0, strokes - 0.1, strokes + 0.1, state.time + 0.2, 0.2)
    nodes = np.tile(np.arange(4), (count, 1))
    rows = ClearanceRows(nodes, np.ones((count, 4, 3)), np.full(count, -1.0))
    return QPInput(
        state.q, state.q, state.control_vertices, state.torsion, target, path.at(0.0), 0.0, rows, motion=True
    )


def test_goals_of_control_vertices_that_come_and_go_in_clutter_leave_one_set_of_bounds():
    """What grows with the rows of one curve's QP must grow for the other that shares its compiled functions."""
    problem = vq.load_problem("five_bay_two_cubes")
    resolver = Resolver(problem)
    tip, _ = resolver.tip()
    for k in range(24):
        resolver.set_control_vertex_goal(4, [0.1, 0.0, 3.0] if k % 6 < 3 else None)
        if k % 4 == 0:
            # More than twice as many rows as ever before: room is made for them, with a goal or without.
            resolver.setup.engine.solve(crowded(resolver, 100 * 3 ** (k // 4)))
        step = resolver.step(position=tip + (k + 1) * np.array([0.032, 0.0, -0.0156]), dt=0.2)
        assert step.status is vq.StepStatus.REACHED, (k, step)


def test_what_holds_an_actuator_is_named_by_the_limit_that_does():
    free = vq.load_problem("five_bay_free")
    slow = vq.Resolver(free.replace({"truss.rate": 0.02, "method.slow_approach": False}))
    step = slow.step(position=[0.2, 0.0, 3.9], dt=0.2)
    assert any(name.startswith("rate: B") for name in step.active), step.active
    gentle = vq.Resolver(free.replace({"truss.acceleration": 0.1, "end_effector.mode": "hard"}))
    step = gentle.step(position=[0.06, 0.0, 4.0], dt=0.2)
    assert step.status is vq.StepStatus.BLOCKED
    assert all(not name.startswith("stroke: ") for name in step.active), step.active


def test_a_trial_curve_without_a_frame_blocks_its_piece_alone(crate_problem, monkeypatch):
    drives_nothing(monkeypatch)
    resolver, target = vq.Resolver(crate_problem), vq.Resolver(crate_problem).tip()[0] + [0.02, 0.0, 0.0]

    def spoil(longest):
        """Let no curve have a frame in pieces of path that are longer."""
        for engine in (resolver.setup.engine, resolver.setup.elastic()):

            def spoilt(asked, *rest, right=engine.move):
                if asked.target.end - asked.target.start > longest:
                    raise vq.CurveError("no frame")
                return right(asked, *rest)

            monkeypatch.setattr(engine, "move", spoilt)

    spoil(0.5)
    step = resolver.step(position=target)
    assert step.status is vq.StepStatus.SLOWED
    assert 0.0 < step.progress <= 0.5
    spoil(0.0)
    assert resolver.step(position=target).reason == "no frame"
