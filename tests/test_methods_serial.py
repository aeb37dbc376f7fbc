"""The pseudoinverse of eq. (5) on serial arms: against differences of the recorded chain, and what it keeps."""

from __future__ import annotations

import numpy as np
import pytest

import vgtm_qp as vq
from vgtm_qp.maneuver.plan import make_plan
from vgtm_qp.methods import PRESETS, methods_for, with_method
from vgtm_qp.methods.objectives import potential_field
from vgtm_qp.problem import Problem
from vgtm_qp.result.chain import RecordedChain
from vgtm_qp.step.build import build_arm

ARMS = ("snake_past_a_cube", "station_arm_past_a_module")
METHODS = [name for name in PRESETS if name.startswith("pseudoinverse")]


def with_changes(name: str, **changes: object) -> Problem:
    problem = with_method(vq.load_problem(name), "pseudoinverse")
    return problem.replace({f"method.{key}": value for key, value in changes.items()})


def tip_jacobian(chain: RecordedChain, q: np.ndarray, h: float = 1e-6) -> np.ndarray:
    """(3, J) derivatives of the tip's position by the joints, by differences of the recorded chain."""
    steps = h * np.eye(len(q))[: len(q) - 6]
    sides = (chain.tip_position(np.stack([q + side * step for step in steps])) for side in (1.0, -1.0))
    return np.asarray(np.subtract(*sides).T / (2.0 * h))


@pytest.mark.parametrize("name", ARMS)
def test_a_plain_step_is_the_pseudoinverse_of_the_tips_differences(name: str) -> None:
    problem = with_changes(name, null_space=[]).replace({"end_effector.track": ["position"]})
    resolver = vq.Resolver(problem)
    before, tip = resolver.state, resolver.tip()[0]
    J = tip_jacobian(RecordedChain(resolver.setup.arm.record()), before.q)
    way = np.array([0.02, -0.01, 0.015])
    step = resolver.step(position=tip + way)
    assert step.progress == 1.0
    np.testing.assert_allclose(step.state.quantities - before.quantities, np.linalg.pinv(J) @ way, atol=1e-8)
    assert resolver.rank == 3


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("terms", [["stroke_centring"], ["node_rate", "obstacle_potential"]])
def test_a_null_space_step_leaves_the_tip_and_lowers_its_terms(name: str, terms: list[str]) -> None:
    changes = {"end_effector.track": ["position"], "method.null_space": terms, "method.correct": True}
    if "obstacle_potential" in terms:
        changes |= {"method.weights.obstacle_potential": 1e-3, "clearance.influence": 3.0}
    problem = with_changes(name).replace(changes)
    resolver = vq.Resolver(problem)
    plan = make_plan(problem, *resolver.tip())
    resolver.follow(plan.path, 0.0, float(plan.marks[20]))
    setup, tip = resolver.setup, resolver.tip()[0]

    def cost() -> float:
        state = resolver.state
        if terms == ["stroke_centring"]:
            return float(np.square(state.quantities - setup.arm.home_quantities).sum())
        near = setup.monitor.near(setup.arm.points(state.q), 0.0, setup.influence)
        return float(np.square(setup.influence / near.distance - 1.0).sum())

    before = cost()
    resolver.step(position=tip)
    assert np.abs(resolver.tip()[0] - tip).max() < 1e-9
    assert cost() < before


@pytest.mark.parametrize("method", METHODS)
def test_every_variant_moves_a_serial_arm_along_its_path(method: str) -> None:
    problem = methods_for(vq.load_problem("snake_past_a_cube"))[method].replace({"obstacle": []})
    maneuver = vq.solve(problem.replace({"maneuver.steps": 200}))
    assert maneuver.arrived
    off = np.linalg.norm(maneuver.tip_position - maneuver.tip_target_position, axis=1).max()
    # An uncorrected step is wrong by its square.
    assert off < (1e-9 if problem.method.correct else 5e-3)
    assert maneuver.status == ("solved" if problem.method.correct else "infeasible")


def test_with_the_same_terms_the_qp_takes_the_same_step() -> None:
    problem = vq.load_problem("snake_past_a_cube").replace({"obstacle": []})
    terms = ["node_rate", "actuator_rate", "stroke_centring"]
    other = with_changes("snake_past_a_cube", correct=True, null_space=terms).replace({"obstacle": []})
    problem = with_method(problem, "qp-none").replace({"method.slow_approach": False})
    ends = []
    for one in (problem, other):
        resolver = vq.Resolver(one)
        target = resolver.tip()[0] + np.array([2e-4, 1e-4, -1e-4])
        assert resolver.step(position=target).progress == 1.0
        ends.append(resolver.state.quantities)
    moved = np.abs(ends[1] - resolver.setup.arm.home_quantities).max()
    # The QP is linearised at the middle of the step, which is of second order.
    assert np.abs(ends[0] - ends[1]).max() < 1e-2 * moved


def test_a_locked_joint_is_held_and_lowers_no_rank() -> None:
    problem = with_changes("snake_past_a_cube", correct=True)
    resolver = vq.Resolver(problem)
    resolver.step(position=resolver.tip()[0] + 0.02)
    resolver.lock("yaw-3")
    held = resolver.state.quantities[resolver.setup.arm.quantity_names.index("yaw-3")]
    before = resolver.state.quantities
    target = resolver.tip()[0] + np.array([0.05, -0.02, -0.02])
    assert resolver.step(position=target).progress == 1.0
    np.testing.assert_allclose(resolver.tip()[0], target, atol=1e-9)
    moved = resolver.state.quantities - before
    assert resolver.state.quantities[resolver.setup.arm.quantity_names.index("yaw-3")] == held
    assert (moved != 0.0).sum() == len(moved) - 1


@pytest.mark.parametrize("correct", [True, False])
def test_a_moving_base_is_made_up_for_by_the_joints(correct: bool) -> None:
    problem = with_changes("snake_past_a_cube", correct=correct).replace(
        {
            "arm.base_motion": [
                {"time": 1.0, "position": [0.01, 0.0, 0.005], "rotation_vector": [0.0, 0.01, 0.0]}
            ]
        }
    )
    resolver = vq.Resolver(problem)
    tip = resolver.tip()[0]
    for _ in range(10):
        resolver.step(position=tip, dt=0.1)
    np.testing.assert_allclose(resolver.state.nodes[0], [0.01, 0.0, 0.005], atol=1e-12)
    assert np.abs(resolver.tip()[0] - tip).max() < (1e-9 if correct else 2e-4)


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("snake_past_a_cube", {}),
        ("offset_joints_past_a_cube", {}),
        ("station_arm_past_a_module", {"clearance.influence": 3.0}),
    ],
)
def test_the_potentials_gradient_by_nodes_is_that_by_the_configuration(name: str, changes: dict) -> None:
    rng = np.random.default_rng(5)
    setup = build_arm(
        vq.load_problem(name).replace({"method.solver": "piqp", "clearance.influence": 1.5} | changes)
    )
    arm, kinematics = setup.arm, setup.kinematics
    q = arm.home_configuration.copy()
    if arm.bays is None:
        q[:-6] += rng.normal(scale=0.02, size=len(q) - 6)
    else:
        q[arm.free] += rng.normal(scale=0.005, size=(len(arm.free), 3))

    def potential(at: np.ndarray) -> float:
        near = setup.monitor.near(arm.points(at), 0.0, setup.influence)
        return float(np.sum(0.5 * (setup.influence / near.distance - 1.0) ** 2))

    gradient, _ = potential_field(setup, q, 0.0)
    assert np.abs(gradient).max() > 0.1
    kinematics.evaluate(q)
    for _ in range(5):
        direction = np.zeros_like(q)
        if arm.bays is None:
            direction[:-6] = rng.normal(size=len(q) - 6)
            moved = (kinematics.motion().response()[0] @ direction[arm.actuators]).reshape(-1, 3)
        else:
            direction[arm.free] = moved = rng.normal(size=(len(arm.free), 3))
        h = 1e-6
        slope = (potential(q + h * direction) - potential(q - h * direction)) / (2.0 * h)
        assert slope == pytest.approx(float(np.sum(gradient[arm.free] * moved)), rel=1e-4, abs=1e-4)
