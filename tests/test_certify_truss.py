"""Trajectories of trusses: the motion is followed with a proof, and what is certified is so at every instant."""

from __future__ import annotations

import importlib
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arms import arm_problem, central_differences
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from oracle import norm
from scipy.sparse.linalg import spsolve

import vgtm_qp as vq
from vgtm_qp.arm.build import make_arm
from vgtm_qp.arm.truss.arm import TrussArm
from vgtm_qp.arm.truss.determinacy import length_jacobian
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.certify.certify import Certifier
from vgtm_qp.certify.truss_motion import TrussSolver, TubeBounds, truss_motion, tube
from vgtm_qp.verify.arm import RecordedArm

Array = NDArray[np.float64]
MODULES = ("octahedral", "double-octahedral", "hexapod", "longeron", "tetrahedral")


def recorded(problem: vq.Problem) -> RecordedArm:
    arm = make_arm(problem)
    return RecordedArm(arm.record(), arm.bodies.joints)


def two_bays(module: str = "octahedral", offset: float = 0.0, **more: Any) -> vq.Problem:
    truss = {"module": module, "actuated": [1, 2, 3] if module == "tetrahedral" else None}
    return arm_problem(truss=truss | {"joint_offset": offset}, **more)


def actuator_rows(rng: np.random.Generator, arm: RecordedArm, rows: int, step: float) -> Array:
    """(T, M) lengths that start at home, whose actuators walk at random."""
    walk = np.zeros((rows, len(arm.length)))
    walk[1:, arm.actuated] = step * rng.normal(size=(rows - 1, int(arm.actuated.sum())))
    return arm.length + np.cumsum(walk, axis=0)


def followed(solver: TrussSolver, start: Array, lengths: Array, steps: int) -> Array:
    """(steps + 1, N, 3) nodes as the lengths go in a straight line, by many small Newton steps."""
    nodes, found = start, [start]
    before = solver.arm.lengths(start)
    for k in range(1, steps + 1):
        nodes = solver.solve(nodes[None], (before + k / steps * (lengths - before))[None])[0][0]
        found.append(nodes)
    return np.array(found)


@pytest.mark.parametrize("offset", [0.0, 0.06])
@pytest.mark.parametrize("module", MODULES)
def test_a_tube_holds_the_motion_and_its_bends(module: str, offset: float, rng: np.random.Generator) -> None:
    arm = recorded(two_bays(module, offset))
    solver = TrussSolver(arm)
    closed = 0
    for step in (0.0005, 0.002, 0.01, 0.04):
        start, end = actuator_rows(rng, arm, 3, step)[1:]
        first, solved = solver.solve(arm.home[None], start[None])
        assert solved[0]
        found = tube(solver, first, start[None], (end - start)[None])
        if not found.closed[0]:
            continue
        closed += 1
        ways = followed(solver, first[0], end, 100)
        start_again = np.broadcast_to(ways[0], ways.shape)
        assert (solver.apart(start_again, ways - ways[0]).max(axis=0) <= found.apart[0] + 1e-12).all()
        ends = arm.ends(ways)
        speed = np.linalg.norm(np.diff(ends, axis=0), axis=3).max(axis=(0, 2)) * 100
        assert (speed <= found.speed[0] * (1.0 + 1e-6) + 1e-9).all()
        bend = np.linalg.norm(np.diff(ends, n=2, axis=0), axis=3).max(axis=(0, 2)) * 100**2
        assert (bend <= found.bend[0] * (1.0 + 1e-6) + 1e-8).all()
        # An error of lengths may move nodes more at the end than at the start.
        last = np.linalg.norm(solver.inverse(ways[-1:])[0], axis=1).sum(axis=1).max()
        assert last <= found.sensitivity[0]
        # The bounds are of use: within some hundred times the greatest that there is.
        assert found.bend[0].max() <= 300.0 * bend.max() + 1e-6
    assert closed


@given(
    edges=st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6),
    ways=st.lists(st.floats(-1.0, 1.0), min_size=12, max_size=12),
)
def test_the_second_derivatives_of_offset_ends_and_lengths_are_within_their_bounds(
    edges: list[float], ways: list[float]
) -> None:
    arm = recorded(tripod(0.05))
    solver = TrussSolver(arm)
    # Two of the feet move here; the frames of all four joints turn with them.
    nodes = arm.home + np.vstack([np.reshape(edges, (2, 3)), np.zeros((2, 3))])
    one, other = (np.vstack([np.reshape(way, (2, 3)), np.zeros((2, 3))]) for way in (ways[:6], ways[6:]))
    with np.errstate(all="ignore"):
        deformed = solver.apart(nodes[None], np.stack([one, other], axis=-1)[None])[0, len(arm.members) :]
    steepest = float(deformed.max())
    assume(np.isfinite(steepest) and 1e-2 < steepest < 1e2)
    h = 1e-3 / steepest
    corners = nodes + h * np.array([one + other, one - other, other - one, -one - other])
    mixed = np.einsum("k,k...->...", [1.0, -1.0, -1.0, 1.0], arm.ends(corners)) / (4.0 * h * h)
    joint = solver.joints
    small = TubeBounds(solver, np.full((1, len(arm.members) + len(deformed)), 1e-3), arm.length[None])
    bound = small.bends[0] / 1e-3**2 * deformed[joint, 0] * deformed[joint, 1]
    assert (np.linalg.norm(mixed, axis=2) <= bound * 1.01 + 1e-6 * steepest**2).all()
    # What `TubeBounds` says of a neighbourhood holds for the gradient at any place in it, along any way.
    moved = one * 0.05 / steepest
    kept = solver.apart(nodes[None], moved[None])
    gradient, index = arm.length_gradient(np.stack([nodes, nodes + moved]))
    changed = np.abs(((gradient[1] - gradient[0]) * other[index]).sum(axis=(1, 2)))
    rates = solver.slots(solver.apart(nodes[None], other[None]))
    assert (
        changed <= TubeBounds(solver, kept, arm.lengths(nodes)[None]).errors(rates)[0] + 1e-9 * steepest
    ).all()


@pytest.mark.parametrize("offset", [0.0, 0.06])
@pytest.mark.parametrize("module", MODULES)
def test_gradients_of_lengths_are_those_of_finite_differences(
    module: str, offset: float, rng: np.random.Generator
) -> None:
    arm = recorded(two_bays(module, offset))
    nodes = arm.home + 0.05 * rng.normal(size=arm.home.shape)
    gradient, index = arm.length_gradient(nodes)
    dense = np.zeros((len(arm.members), *arm.home.shape))
    for slot in range(index.shape[1]):
        dense[np.arange(len(index)), index[:, slot]] += gradient[:, slot]
    np.testing.assert_allclose(dense, central_differences(arm.lengths, nodes), atol=1e-8)


def tripod(offset: float = 0.0) -> vq.Problem:
    # Three members in a plane hold a node that can leave it.
    nodes = [
        {"name": name, "position": position, "fixed": name != "top"}
        for name, position in {"a": [1, 0, 0], "b": [-1, 1, 0], "c": [-1, -1, 0], "top": [0, 0, 0.02]}.items()
    ]
    members = [
        {"name": f"{name}-top", "nodes": [name, "top"], "actuated": True, "stroke": [0.5, 3.0]}
        for name in "abc"
    ]
    truss = {"module": "graph", "node": nodes, "member": members, "tip": ["top"], "member_radius": 0.01}
    return vq.Problem.from_dict(
        {
            "truss": truss | {"joint_offset": offset},
            "maneuver": {"waypoint": [{"time": 1.0, "position": [0.0, 0.0, 0.1]}]},
            "method": {"tracking": "none"},
            "clearance": {"safe": 0.01, "influence": 0.1, "self_collision": False},
        }
    )


@pytest.mark.parametrize("size", [1e200, np.inf, np.nan])
def test_numbers_that_overflow_prove_nothing(size: float) -> None:
    arm = recorded(tripod())
    solver = TrussSolver(arm)
    inverse = solver.inverse
    solver.inverse = lambda nodes: inverse(nodes) * size  # type: ignore[method-assign]
    assert not tube(solver, arm.home[None], arm.length[None], np.full((1, 3), 1e-3)).closed.any()
    solver.inverse = lambda nodes: inverse(nodes) * 1e160 * size  # type: ignore[method-assign]
    assert not tube(solver, arm.home[None], arm.length[None], np.full((1, 3), 1e-3)).closed.any()


def test_nodes_of_the_same_lengths_elsewhere_are_not_taken_for_the_motion(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    arm = recorded(tripod())
    lengths = arm.length + np.array([[0.0], [0.05]])
    motion, doubts = truss_motion(arm, np.array([0.0, 1.0]), lengths, {})
    assert motion is not None
    assert not doubts
    half, middle = np.full(len(motion.time) - 1, 0.5), np.arange(len(motion.time) - 1)
    above = motion.ends_at(middle, half)
    assert not list(motion.doubts())
    solve = TrussSolver.solve

    def under(self: TrussSolver, nodes: Array, lengths: Array) -> tuple[Array, NDArray[np.bool_]]:
        right, found = solve(self, nodes, lengths)
        return right * np.array([1.0, 1.0, -1.0]), found

    monkeypatch.setattr(TrussSolver, "solve", under)
    below = motion.ends_at(middle, half)
    np.testing.assert_allclose(np.linalg.norm(np.diff(below, axis=2)), np.linalg.norm(np.diff(above, axis=2)))
    assert [doubt.reason for doubt in motion.doubts()] == [
        "its nodes were not found to the last digits"
    ] * len(middle)


@pytest.mark.parametrize("offset", [0.0, 0.05])
def test_a_tube_does_not_close_at_a_singular_pose(offset: float) -> None:
    problem = tripod(offset)
    arm = recorded(problem)
    shorter = arm.length - 0.001
    (finding,) = vq.certify(problem, [0.0, 1.0], [arm.length, shorter]).undecided
    assert finding.kind == "motion"
    assert (finding.start, finding.end) == (0.0, 1.0)
    assert "singular" in finding.reason
    assert vq.certify(problem, [0.0, 1.0], [arm.length, arm.length + 0.05]).certified
    # Where it cannot be reached from home, nothing is said of it.
    far = vq.certify(problem, [0.0], [shorter])
    assert far.answer == "undecided"
    assert far.clearance == -np.inf
    assert far.to_dict()["clearance"] is None
    assert "home" in far.undecided[0].reason


@pytest.mark.parametrize("module", MODULES)
def test_what_sampling_finds_is_above_what_is_proven(module: str, rng: np.random.Generator) -> None:
    answers = set()
    for size in (0.1, 0.2, 0.3):
        problem = two_bays(module)
        arm = recorded(problem)
        rows = actuator_rows(rng, arm, 4, 0.02)
        solver = TrussSolver(arm)
        tops = followed(solver, arm.home, rows[-1], 20)[-1]
        middle = 0.5 * (tops[arm.tip].mean(axis=0) + arm.home[arm.tip].mean(axis=0))
        away = np.append(rng.normal(size=2), 0.3)
        center = middle + 0.7 * away / np.linalg.norm(away)
        ball = {"name": "ball", "shape": "sphere", "center": center.tolist(), "radius": size}
        scene = problem.replace(
            {"obstacle": [ball], "clearance.safe": 0.02, "clearance.self_collision": False}
        )
        times = np.arange(4.0)
        certifier = Certifier(scene)
        verdict = certifier.certify(times, rows[:, certifier.columns.quantities])
        ways, nodes = [], arm.home
        for row in rows[1:]:
            ways.append(followed(solver, nodes, row, 300))
            nodes = ways[-1][-1]
        ends = arm.ends(np.concatenate(ways))
        along = np.linspace(0, 1, 41)[:, None]
        points = ends[:, :, None, 0] + along * (ends[:, :, None, 1] - ends[:, :, None, 0])
        apart = np.maximum(np.linalg.norm(points - center, axis=-1).min(axis=(0, 2)) - size, 0.0) - arm.radius
        assert verdict.clearance <= apart.min() + 1e-9
        clear = [found for found in (*verdict.violations, *verdict.undecided) if found.kind == "clearance"]
        assert clear or apart.min() >= 0.02 - 1e-9
        answers.add(verdict.answer)
    assert answers <= {"certified", "violated"}


def two_tripods() -> vq.Problem:
    feet = {
        f"{x}{k}": [1.5 * x + 0.6 * np.cos(w), 0.6 * np.sin(w), 0.0]
        for x in (0, 1)
        for k, w in enumerate((0, 2, 4))
    }
    nodes = [{"name": name, "position": place, "fixed": True} for name, place in feet.items()]
    nodes += [{"name": f"top{x}", "position": [1.5 * x, 0.0, 0.8]} for x in (0, 1)]
    members = [
        {"name": f"m{foot}", "nodes": [foot, f"top{foot[0]}"], "actuated": True, "stroke": [0.1, 5.0]}
        for foot in feet
    ]
    truss = {"module": "graph", "node": nodes, "member": members, "tip": ["top0"], "member_radius": 0.01}
    return vq.Problem.from_dict(
        {
            "truss": truss,
            "maneuver": {"waypoint": [{"time": 1.0, "position": [0.0, 0.0, 0.9]}]},
            "method": {"tracking": "none"},
            "clearance": {"safe": 0.1, "influence": 5.0},
        }
    )


def test_members_that_pass_one_another_between_rows_are_found(rng: np.random.Generator) -> None:
    problem = two_tripods()
    arm = recorded(problem)
    for _ in range(4):
        aside, rows = np.array([0.0, 0.35, 0.0]) + rng.uniform(-0.1, 0.1, 3), []
        for side in (-1.0, 1.0):
            nodes = arm.home.copy()
            nodes[arm.free] += np.array([[0.7, 0.0, 0.0], [-0.7, 0.0, 0.1]]) + side * np.array(
                [aside, -aside]
            )
            rows.append(arm.lengths(nodes))
        solver = TrussSolver(arm)
        start = followed(solver, arm.home, rows[0], 50)[-1]
        ends = arm.ends(followed(solver, start, rows[1], 200))
        along = np.linspace(0.0, 1.0, 31)[:, None]
        points = ends[:, :, None, 0] + along * (ends[:, :, None, 1] - ends[:, :, None, 0])
        apart = np.linalg.norm(points[:, :3, None, :, None] - points[:, None, 3:, None], axis=-1)
        at_rows, least = apart[[0, -1]].min() - 0.02, apart.min() - 0.02
        assert 0.01 < least < at_rows - 0.05
        nearer = Certifier(problem.replace({"clearance.self_safe": float(least + 1e-3)})).certify(
            [0.0, 1.0], rows
        )
        assert {each.kind for each in nearer.violations} == {"self-clearance"}
        assert nearer.self_clearance <= least + 1e-9
        assert vq.certify(
            problem.replace({"clearance.self_safe": float(least - 0.01)}), [0.0, 1.0], rows
        ).certified


def test_what_our_own_solver_made_is_certified() -> None:
    problem = two_bays(steps=6)
    maneuver = vq.solve(problem)
    lengths = maneuver.member_lengths[:, maneuver.member_actuated]
    verdict = vq.certify(problem, maneuver.time, lengths)
    assert verdict.certified, str(verdict)
    # Chords of long steps are not the arcs that the nodes take.
    assert verdict.self_clearance == pytest.approx(
        maneuver.certificate.self_clearance_between.value, abs=5e-3
    )
    named = dict(zip(maneuver.actuator_names, lengths.T, strict=True))
    assert vq.certify(problem, maneuver.time, named).self_clearance == verdict.self_clearance
    too_long = lengths.copy()
    too_long[-1, 0] = 1.6
    found = vq.certify(problem, maneuver.time, too_long)
    assert "limit" in {finding.kind for finding in found.violations}


def test_a_truss_is_certified_on_a_base_that_moves() -> None:
    problem = vq.load_problem("moving_base").replace({"maneuver.steps": 10})
    maneuver = vq.solve(problem)
    lengths = maneuver.member_lengths[:, maneuver.member_actuated]
    verdict = vq.certify(problem, maneuver.time, lengths)
    assert verdict.clearance <= maneuver.clearance.min() + 1e-9
    assert not verdict.undecided
    still = problem.replace({"truss.base_motion": []})
    # On a base that stays the same lengths lead elsewhere.
    assert vq.certify(still, maneuver.time, lengths).clearance != pytest.approx(verdict.clearance, abs=1e-3)


def test_what_is_locked_keeps_its_length() -> None:
    problem = two_bays(steps=3)
    arm = recorded(problem)
    actuated = np.flatnonzero(arm.actuated)
    name = arm.member_names[int(actuated[0])]
    stuck = problem.replace({"truss.locked": [name]})
    home = arm.length[actuated]
    rest = {arm.member_names[k]: [arm.length[k], arm.length[k] + 0.01] for k in actuated[1:].tolist()}
    assert vq.certify(stuck, [0.0, 1.0], rest).certified
    (finding,) = vq.certify(stuck, [0.0, 1.0], rest | {name: [home[0], home[0] + 0.01]}).violations
    assert (finding.kind, finding.names) == ("lock", (name,))


def sampled(truss: Truss, rows: Array, steps: int) -> Array:
    """(T, M, 2, 3) members' ends at many instants between rows of lengths, by the code that moves the arm."""
    nodes, found = truss.home.copy(), [truss.member_ends(truss.home)]
    for before, after in pairwise(rows):
        for share in np.linspace(0.0, 1.0, steps + 1)[1:]:
            for _ in range(3):
                missing = (
                    before + share * (after - before) - norm(np.diff(truss.member_ends(nodes), axis=1)[:, 0])
                )
                nodes[truss.free] += spsolve(length_jacobian(truss, nodes), missing).reshape(-1, 3)
            found.append(truss.member_ends(nodes))
    return np.array(found)


def beside_its_path(rng: np.random.Generator, module: str) -> tuple[vq.Problem, Array, float] | None:
    """A ball beside a point of a truss with offset joints that is nearer between two rows than at any row.

    The problem, the rows of its actuators' lengths, and the least clearance that sampling finds.
    """
    problem = two_bays(module, float(rng.choice([0.02, 0.06])))
    arm = make_arm(problem)
    assert isinstance(arm, TrussArm)
    truss = arm.truss
    steps, rows = 40, actuator_rows(rng, recorded(problem), int(rng.integers(2, 5)), 0.03)
    ends = sampled(truss, rows, steps)
    k = steps * int(rng.integers(len(rows) - 1)) + int(rng.integers(10, 30))
    member, at = int(rng.integers(len(truss.members))), rng.uniform()
    path = ends[:, member, 0] + at * (ends[:, member, 1] - ends[:, member, 0])
    away = np.cross(ends[k, member, 1] - ends[k, member, 0], path[k + 1] - path[k - 1])
    if norm(away) < 1e-4:
        return None
    radius, distance = 0.005, truss.radius[member] + 0.03
    center = path[k] + away / norm(away) * (radius + distance)
    axis = ends[:, :, 1] - ends[:, :, 0]
    along = np.clip(((center - ends[:, :, 0]) * axis).sum(-1) / (axis * axis).sum(-1), 0.0, 1.0)
    apart = norm(center - ends[:, :, 0] - along[..., None] * axis) - truss.radius - radius
    if apart[::steps].min() < apart.min() + 5e-4 or apart.min() < 2e-3:
        return None
    ball = {"name": "ball", "shape": "sphere", "center": center.tolist(), "radius": radius}
    scene = problem.replace(
        {"obstacle": [ball], "clearance.self_collision": False, "truss.stroke": [0.1, 9.0]}
    )
    return scene, rows[:, truss.actuated], float(apart.min())


@pytest.mark.parametrize("module", MODULES)
def test_what_offset_joints_pass_between_rows_is_found_and_what_is_clear_is_certified(
    module: str, rng: np.random.Generator
) -> None:
    drawn = (beside_its_path(rng, module) for _ in range(40))
    found = list(islice(filter(None, drawn), 2))
    assert len(found) == 2
    for scene, rows, least in found:
        nearer = vq.certify(scene.replace({"clearance.safe": least + 1e-4}), np.arange(len(rows)), rows)
        assert {finding.kind for finding in nearer.violations} == {"clearance"}
        assert nearer.clearance <= least + 1e-9
        clear = vq.certify(scene.replace({"clearance.safe": least - 1e-3}), np.arange(len(rows)), rows)
        assert clear.certified, str(clear)


def test_a_maneuver_with_offset_joints_is_certified_from_its_table(tmp_path: Path) -> None:
    problem = vq.load_problem("offset_joints_past_a_cube").replace({"maneuver.steps": 10})
    maneuver = vq.solve(problem)
    table = vq.export_maneuver(maneuver, tmp_path / "lengths.csv")
    verdict = Certifier(problem.replace({"clearance.safe": 0.079})).certify_file(table)
    assert verdict.certified, str(verdict)
    assert verdict.clearance <= maneuver.clearance.min() + 1e-9


def test_a_motion_that_cannot_be_followed_to_its_end_is_certified_to_where_it_can(monkeypatch: Any) -> None:
    module = importlib.import_module("vgtm_qp.certify.truss_motion")
    monkeypatch.setattr(module, "GREATEST_DEPTH", 1)
    problem = two_bays()
    arm = recorded(problem)
    lengths = np.tile(arm.length, (3, 1))
    lengths[2, arm.actuated] += np.linspace(0.0, 0.4, int(arm.actuated.sum()))
    motion, doubts = truss_motion(arm, np.array([0.0, 1.0, 2.0]), lengths, problem.to_dict())
    assert motion is not None
    assert motion.time[-1] == 1.0
    assert [(doubt.start, doubt.end) for doubt in doubts] == [(1.0, 2.0)]
