"""Parts that a user brings: by argument and by entry point, with a message for each way to get them wrong."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

import vgtm_qp as vq
from vgtm_qp import parts
from vgtm_qp.curve.families import b_spline, beta_spline
from vgtm_qp.parts import find_part, part_names
from vgtm_qp.qp.daqp import DAQP
from vgtm_qp.qp.dense import EQUALITY, DenseQP
from vgtm_qp.qp.numbers import UNBOUNDED
from vgtm_qp.rotation import rotation_from_vector

WAYPOINT = {"maneuver.waypoint": [{"time": 2.0, "position": [0.05, 0.0, 1.9]}], "maneuver.steps": 2}


def tripod(*, bays: int, height: float = 1.0, short: float = 0.5) -> dict[str, Any]:
    """Return stacked platforms on six legs; shorter ones than `short` are refused."""
    if height < short:
        raise ValueError(f"a height of {height:g} m is below {short:g} m")
    nodes, members, faces = [], [], []
    for layer in range(bays + 1):
        angles = (layer % 2) * np.pi / 3.0 + 2.0 * np.pi * np.arange(3) / 3.0
        points = np.column_stack([0.5 * np.cos(angles), 0.5 * np.sin(angles), np.full(3, layer * height)])
        faces.append([f"n{layer}-{k}" for k in range(3)])
        nodes += [
            {"name": name, "position": point, "fixed": layer == 0}
            for name, point in zip(faces[-1], points, strict=True)
        ]
        for k in range(3) if layer else ():
            members.append({"name": f"edge{layer}-{k}", "nodes": [faces[-1][k], faces[-1][(k + 1) % 3]]})
            for j in (k, (k + 1) % 3) if layer % 2 else (k, (k + 2) % 3):
                ends = [faces[-1][k], faces[-2][j]]
                members.append({"name": f"leg{layer}-{k}{j}", "nodes": ends, "actuated": True})
    return {"node": nodes, "member": members, "tip": faces[-1], "faces": faces}


@pytest.fixture(autouse=True)
def _forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "REGISTERED", {kind: {} for kind in parts.REGISTERED})
    vq.register("module", "tripod", tripod)


def with_truss(**keys: Any) -> vq.Problem:
    table = {"module": "tripod", "bays": 2, "stroke": [0.5, 2.0], **keys}
    return vq.load_problem("five_bay_free").replace({"truss": table, **WAYPOINT})


# Modules.


def test_a_module_moves_and_its_result_needs_it_no_more(tmp_path: Path):
    problem = with_truss(rate=0.4, member_radius=0.02, locked=["leg2-00"])
    maneuver = vq.solve(problem)
    assert maneuver.status == "solved"
    assert maneuver.certificate.ok, str(maneuver.certificate)
    assert maneuver.manifest["problem"]["truss"]["module"] == "graph"
    assert maneuver.manifest["problem"]["truss"]["rate"] == 0.4
    maneuver.save(tmp_path / "own.npz")
    assert vq.verify_file(tmp_path / "own.npz", problem=problem).ok
    other = vq.verify_file(tmp_path / "own.npz", problem=problem.replace({"truss.height": 1.1}))
    assert not other.ok


def test_other_processes_need_no_part_that_has_become_tables():
    """They know none that a script has registered; a retry there changes the tables that the part has made."""
    vq.register("curve", "own", lambda: UNEVEN)
    vq.register("obstacle", "dumbbell", dumbbell)
    tables = {"curve": {"family": "own"}, "obstacle": [{**WEIGHT, "center": [2.0, 0.0, 1.0]}]}
    (maneuver,) = vq.solve_many([with_truss().replace(tables)], workers=1)
    assert maneuver.status == "solved"
    assert maneuver.certificate.ok
    parts.REGISTERED["module"].clear()
    assert (
        with_truss_of(maneuver).replace({"method.weights.node_rate": 2.0}).truss
        == with_truss_of(maneuver).truss
    )


def with_truss_of(maneuver: vq.Maneuver) -> vq.Problem:
    return vq.Problem.from_dict(maneuver.manifest["problem"])


def test_keys_of_a_module_can_be_replaced():
    problem = with_truss()
    taller = problem.replace({"truss.bays": 3, "truss.rate": 0.2})
    assert taller.truss is not None
    assert len(taller.truss.node) == 12  # type: ignore[union-attr]
    assert taller.truss.rate == 0.2
    assert problem.replace({"name": "another"}).truss == problem.truss


@pytest.mark.parametrize(
    ("keys", "key", "expected"),
    [
        ({"module": "tripot"}, "truss.module", 'did you mean "tripod"?'),
        ({"heigth": 1.0}, "truss.heigth", 'did you mean "height"?'),
        ({"bays": "five"}, "truss.bays", "integer"),
        ({"height": 0.4}, "truss", "a height of 0.4 m is below 0.5 m"),
        ({"rate": -1.0}, "truss.rate", "a limit greater than 0"),
        ({"stroke": [1.5, 2.0]}, "truss.stroke", "a stroke that holds the home length"),
    ],
)
def test_mistakes_in_the_table_of_a_module_are_named(keys: dict[str, Any], key: str, expected: str):
    with pytest.raises(vq.ProblemError) as caught:
        with_truss(**keys)
    for mistake in caught.value.mistakes:
        assert mistake.key.startswith(key)
        assert expected in mistake.expected


def test_a_key_that_a_module_needs_is_missed():
    with pytest.raises(vq.ProblemError, match=r"truss\.bays: found nothing; expected a value"):
        vq.load_problem("five_bay_free").replace({"truss": {"module": "tripod"}})


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        (lambda: None, "returned nothing"),
        (lambda: {"node": [], "member": [], "tip": []}, "at least"),
        (lambda: {**tripod(bays=1), "nodes": []}, 'did you mean "node"'),
        (lambda: {**tripod(bays=1), "tip": ["n9-0"]}, "the name of one of"),
    ],
)
def test_wrong_answers_of_a_module_are_mistakes(answer: Callable[[], Any], expected: str):
    vq.register("module", "wrong", answer)
    with pytest.raises(vq.ProblemError, match=re.escape(expected)):
        vq.load_problem("five_bay_free").replace({"truss": {"module": "wrong"}})


# Curve families.

UNEVEN = ([0.0, 0.3, 1.0], [[[1, 0, 0], [0.6, 0.4, 0], [0, 1, 0]], [[0, 1, 0], [0, 0.5, 0.5], [0, 0, 1]]])
"""Two quadratic segments over three control vertices, without linear precision."""


def with_family(answer: Any, **changes: Any) -> vq.Problem:
    vq.register("curve", "mine", lambda: answer)
    return vq.load_problem("five_bay_free").replace(
        {"curve": {"family": "mine"}, "maneuver.steps": 5, **changes}
    )


def changed(segment: int, point: int, weights: list[float]) -> tuple[Any, Any]:
    """Return the uneven family with other weights of one Bezier point."""
    extraction = np.array(UNEVEN[1], dtype=float)
    extraction[segment, point] = weights
    return UNEVEN[0], extraction


def test_the_package_s_own_curve_as_segments_moves_the_arm_the_same_way():
    problem = vq.load_problem("five_bay_two_cubes").replace({"maneuver.steps": 10})
    for family in (b_spline(6), beta_spline(6, 1.5, 2.0)):
        options = {"bias": family.bias, "tension": family.tension} if family.name == "beta-spline" else {}
        known = vq.solve(problem.replace({"curve": {"family": family.name, **options}}))
        answer = family.breaks, family.extraction
        vq.register("curve", "mine", lambda answer=answer: answer)
        own = vq.solve(problem.replace({"curve": {"family": "mine"}}))
        assert own.certificate.ok
        assert own.manifest["problem"]["curve"]["family"] == "segments"
        np.testing.assert_allclose(own.control_vertices, known.control_vertices, atol=1e-6)


def test_a_family_without_linear_precision_is_verified_with_its_segments(tmp_path: Path):
    goal = [{"time": 10.0, "position": [0.3, 0.0, 3.9]}]
    problem = with_family(UNEVEN, **{"maneuver.waypoint": goal, "method.tracking_mode": "hard"})
    maneuver = vq.solve(problem)
    assert maneuver.certificate.ok, str(maneuver.certificate)
    assert maneuver.certificate.tracking_gap.value < 1e-9
    maneuver.save(tmp_path / "own.npz")
    assert vq.verify_file(tmp_path / "own.npz", problem=problem).ok
    assert vq.load_result(tmp_path / "own.npz").certificate.ok


def test_a_family_of_ones_own_keeps_its_number_of_control_vertices_while_the_arm_runs():
    resolver = vq.Resolver(with_family(UNEVEN))
    for count in (4, 2):
        with pytest.raises(vq.CurveError):
            resolver.set_control_vertices(count)
    assert resolver.step(position=[0.02, 0.0, 4.0]).status is vq.StepStatus.REACHED


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        (([0.0, 0.5], UNEVEN[1]), "1 segments, one between two breaks"),
        ((UNEVEN[0], UNEVEN[1][0]), "two arrays from the curve"),
        (None, "two arrays from the curve"),
        (([0.0, 0.3, 0.9], UNEVEN[1]), "breaks that increase from 0 to 1"),
        (changed(0, 1, [0.6, 0.5, 0]), "weights whose sum is 1"),
        (changed(0, 2, [0.1, 0.9, 0]), "segments that begin where the one before ends"),
        (changed(0, 0, [0.9, 0.1, 0]), "first control vertex"),
        (changed(1, 2, [0, 0.1, 0.9]), "last control vertex"),
        (changed(0, 1, [0.6, 0.3, 0.1]), "first leg of the control polygon"),
        (changed(0, 1, [1.4, -0.4, 0]), "a weight above 0"),
    ],
)
def test_wrong_answers_of_a_family_are_mistakes(answer: Any, expected: str):
    with pytest.raises(vq.ProblemError, match=re.escape(expected)):
        vq.Resolver(with_family(answer))


def test_segments_in_a_file_fit_one_another():
    table = {"family": "segments", "breaks": [0.0, 1.0], "control_vertices": 3}
    for extraction, expected in (
        ([[[1, 0, 0], [0, 1]]], "3 weights, one a control vertex"),
        ([[[1, 0, 0]]], "2 points, one more than the degree"),
    ):
        with pytest.raises(vq.ProblemError, match=expected):
            vq.load_problem("five_bay_free").replace({"curve": {**table, "extraction": extraction}})


# Shapes of obstacles.


def dumbbell(*, radius: float, length: float = 1.0) -> list[dict[str, Any]]:
    """Return two balls and a bar between them, which lies along the shape's y-axis."""
    if length < 2 * radius:
        raise ValueError(f"the balls overlap at a length of {length:g} m")
    bar = {"shape": "cylinder", "height": length, "radius": radius / 2, "rotation_vector": [np.pi / 2, 0, 0]}
    ends = [
        {"shape": "sphere", "radius": radius, "center": np.array([0.0, y, 0.0])}
        for y in (-length / 2, length / 2)
    ]
    return [{**bar, "name": "bar"}, *ends]


BALL = {"name": "ball", "shape": "sphere", "center": [5.0, 0.0, 1.0], "radius": 0.2}
WEIGHT = {"name": "weight", "shape": "dumbbell", "center": [1.2, 0.3, 2.0], "radius": 0.2}


def with_obstacles(*tables: dict[str, Any], **changes: Any) -> vq.Problem:
    vq.register("obstacle", "dumbbell", dumbbell)
    return vq.load_problem("five_bay_free").replace({"obstacle": list(tables), **changes})


def test_a_shape_becomes_its_pieces_where_the_obstacle_is():
    turned = {"rotation_vector": [0.0, 0.0, np.pi / 2], "velocity": [0.0, 0.0, 0.1]}
    problem = with_obstacles(BALL, {**WEIGHT, **turned})
    assert [one.name for one in problem.obstacle] == ["ball", "weight: bar", "weight: 2", "weight: 3"]
    bar, first, second = problem.obstacle[1:]
    np.testing.assert_allclose(first.center, [1.7, 0.3, 2.0], atol=1e-12)
    np.testing.assert_allclose(second.center, [0.7, 0.3, 2.0], atol=1e-12)
    axis = rotation_from_vector(bar.rotation_vector)[:, 2]
    np.testing.assert_allclose(np.abs(axis), [1.0, 0.0, 0.0], atol=1e-12)
    assert {one.velocity for one in problem.obstacle[1:]} == {(0.0, 0.0, 0.1)}


def test_a_shape_joins_the_scene_of_a_running_arm_piece_by_piece():
    vq.register("obstacle", "dumbbell", dumbbell)
    pieces = vq.obstacles({**WEIGHT, "center": [1.2, 0.0, 2.2]}, BALL)
    assert pieces == with_obstacles({**WEIGHT, "center": [1.2, 0.0, 2.2]}, BALL).obstacle
    resolver = vq.Resolver(vq.load_problem("five_bay_free"))
    for piece in pieces:
        resolver.add_obstacle(piece)
    assert resolver.step(position=[0.02, 0.0, 4.0]).moved
    with pytest.raises(vq.ProblemError, match=r'obstacle\[0\] \("weight"\).radius: found nothing'):
        vq.obstacles({key: value for key, value in WEIGHT.items() if key != "radius"})


def test_a_shape_of_one_piece_has_the_obstacle_s_name():
    vq.register(
        "obstacle", "coin", lambda *, radius: [{"shape": "cylinder", "radius": radius, "height": 0.01}]
    )
    problem = with_obstacles({**WEIGHT, "shape": "coin"})
    assert [(one.name, one.shape) for one in problem.obstacle] == [("weight", "cylinder")]


def test_a_shape_is_kept_clear_of_and_verified_by_its_pieces(tmp_path: Path):
    problem = with_obstacles({**WEIGHT, "center": [1.1, 0.0, 2.2]}, **{"maneuver.steps": 25})
    maneuver = vq.solve(problem)
    assert maneuver.status == "solved"
    assert maneuver.certificate.ok, str(maneuver.certificate)
    assert "weight" in maneuver.certificate.clearance.where
    maneuver.save(tmp_path / "own.npz")
    assert vq.verify_file(tmp_path / "own.npz", problem=problem).ok
    bigger = with_obstacles({**WEIGHT, "center": [1.1, 0.0, 2.2], "radius": 0.3}, **{"maneuver.steps": 25})
    assert not vq.verify_file(tmp_path / "own.npz", problem=bigger).ok


@pytest.mark.parametrize(
    ("table", "key", "expected"),
    [
        ({"shape": "dumbbel"}, 'obstacle[1] ("weight").shape', 'did you mean "dumbbell"?'),
        ({"radios": 1.0}, 'obstacle[1] ("weight").radios', 'did you mean "radius"?'),
        ({"radius": "wide"}, 'obstacle[1] ("weight").radius', "valid number"),
        ({"radius": 0.7}, 'obstacle[1] ("weight")', "the balls overlap at a length of 1 m"),
        ({"radius": -1.0}, 'obstacle[1] ("weight").radius', "a length in metres"),
        ({"center": [0.0]}, 'obstacle[1] ("weight").center', "three numbers"),
        ({"velocity": 1.0}, 'obstacle[1] ("weight").velocity', "three numbers"),
    ],
)
def test_mistakes_in_the_table_of_a_shape_are_named(table: dict[str, Any], key: str, expected: str):
    """Also behind another obstacle of a shape of one's own, whose pieces are more than one."""
    with pytest.raises(vq.ProblemError) as caught:
        with_obstacles({**WEIGHT, "name": "other"}, {**WEIGHT, **table}, {**BALL, "radius": 0.0})
    first, *_, last = caught.value.mistakes
    assert (first.key, last.key) == (key, 'obstacle[2] ("ball").radius')
    assert expected in first.expected


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        ([], "tables of obstacles from the shape"),
        ({"shape": "box"}, "tables of obstacles from the shape"),
        ([{"shape": "box"}], "size: found nothing"),
        ([{"shape": "ball", "radius": 1.0}], '"box", "sphere"'),
        ([{"shape": "box", "size": 1.0, "center": "here"}], "three numbers for each center"),
    ],
)
def test_wrong_answers_of_a_shape_are_mistakes(answer: Any, expected: str):
    vq.register("obstacle", "wrong", lambda: answer)
    with pytest.raises(vq.ProblemError, match=re.escape(expected)):
        with_obstacles({"name": "wrong one", "shape": "wrong", "center": [3.0, 0.0, 1.0]})


# Solvers.


class ByDaqp:
    """Answers by DAQP, spoilt as `spoil` does it, and writes into what it is given."""

    accuracy = 1e-10
    made = asked = 0

    def __init__(self) -> None:
        type(self).made += 1

    def __call__(self, P: Any, q: Any, A: Any, lower: Any, upper: Any) -> Any:
        type(self).asked += 1
        assert np.array_equal(np.isposinf(upper), upper > 1e20)
        bounds = np.maximum(lower, -UNBOUNDED), np.minimum(upper, UNBOUNDED), sense(lower, upper)
        found = DAQP.ask(DenseQP(P, q, A, *bounds))
        for array in (P, q, A, lower, upper):
            array[:] = np.nan
        return self.spoil(found.x, found.multipliers)

    @staticmethod
    def spoil(x: Any, y: Any) -> Any:
        return x, y


def sense(lower: Any, upper: Any) -> Any:
    return np.where(lower == upper, EQUALITY, 0).astype(np.int32)


def solved_by(spoil: Callable[[Any, Any], Any], bays: int = 5) -> vq.Maneuver:
    part = type("Spoilt", (ByDaqp,), {"spoil": staticmethod(spoil)})
    vq.register("solver", "mine", part)
    changes = {"method.solver": "mine", "maneuver.steps": 4, "truss.bays": bays}
    near = {"maneuver.waypoint": [{"time": 10.0, "position": [0.2, 0.0, 0.8 * bays]}]}
    return vq.solve(vq.load_problem("five_bay_free").replace(changes | near))


@pytest.mark.parametrize("bays", [5, 20])
def test_a_solver_gives_the_maneuver_that_daqp_gives(bays: int):
    ByDaqp.made = ByDaqp.asked = 0
    maneuver = solved_by(lambda x, y: (x, y), bays)
    assert maneuver.status == "solved"
    assert maneuver.certificate.ok
    known = vq.solve(vq.Problem.from_dict(maneuver.manifest["problem"]).replace({"method.solver": "daqp"}))
    np.testing.assert_allclose(maneuver.nodes, known.nodes, atol=1e-6)


@pytest.mark.parametrize(
    "spoil", [lambda x, y: (x + 1e-3, y), lambda x, y: (x, 2 * y + 1), lambda x, y: None]
)
def test_wrong_answers_of_a_solver_move_nothing(spoil: Callable[[Any, Any], Any]):
    maneuver = solved_by(spoil)
    assert (maneuver.status, maneuver.steps) == ("blocked", 0)


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (lambda x, y: x[:3], "returned ndarray; expected two arrays"),
        (lambda x, y: (x, y[:2]), "expected two arrays"),
        (lambda x, y: 1, "returned int"),
    ],
)
def test_answers_of_another_form_are_errors(spoil: Callable[[Any, Any], Any], expected: str):
    with pytest.raises(vq.PartError, match=expected):
        solved_by(spoil)


def test_what_a_solver_raises_is_not_lost():
    class Breaking(ByDaqp):
        is_broken = False

        def __call__(self, *qp: Any) -> Any:
            if self.is_broken:
                raise KeyError("no such row")
            return super().__call__(*qp)

    vq.register("solver", "breaking", Breaking)
    resolver = vq.Resolver(vq.load_problem("five_bay_free").replace({"method.solver": "breaking"}))
    assert resolver.step(position=[0.02, 0.0, 4.0]).progress == 1.0
    Breaking.is_broken = True
    with pytest.raises(KeyError, match="no such row"):
        resolver.step(position=[0.04, 0.0, 4.0])


def test_an_unknown_solver_is_answered_with_those_of_ones_own():
    vq.register("solver", "simplex-of-mine", ByDaqp)
    problem = vq.load_problem("five_bay_free").replace({"method.solver": "simplex-of-min"})
    with pytest.raises(vq.ProblemError, match='did you mean "simplex-of-mine"'):
        vq.Resolver(problem)


# Objectives.

PLACE = np.array([0.15, 0.1, 1.6])


def to_place(nodes: Any) -> Any:
    return nodes["n2-1"] - PLACE


SNAKE = {
    "schema_version": 1,
    "arm": {
        "joint": [
            {"name": f"j{k}", "axis": [[1, 0, 0], [0, 1, 0]][k % 2], "home": 0.1, "position": [0, 0, 0.4]}
            for k in range(8)
        ],
        "tip": [0.0, 0.0, 0.4],
    },
    "maneuver": {"steps": 4, "waypoint": [{"time": 3.0, "position": [0.2, -0.9, 3.0]}]},
    "curve": {"control_vertices": 4},
}


def test_the_hessian_and_the_gradient_are_those_of_the_linearised_residual():
    """Against finite differences, at a state away from home, with a nonlinear residual."""

    def residual(nodes: Any) -> list[Any]:
        return [ca.norm_2(nodes["n3-1"] - nodes["n1-2"]) - 2.0, nodes["n4-2"][0] * nodes["n4-2"][2]]

    problem = vq.load_problem("five_bay_free")
    resolver = vq.Resolver(problem, objectives=[vq.Objective("both", residual, weight=3.0)])
    plain = vq.Resolver(problem)
    resolver.step(position=[0.1, 0.02, 3.9])
    plain.state = resolver.state
    qp, known = (one.build(position=[0.2, 0.0, 3.9]) for one in (resolver, plain))
    arm = resolver.setup.arm
    index = {name: k for k, name in enumerate(arm.node_names)}

    def numbers(free: Any) -> Any:
        X = resolver.state.nodes.copy()
        X[arm.free] = free.reshape(-1, 3)
        first, second, third = (X[index[name]] for name in ("n3-1", "n1-2", "n4-2"))
        return np.array([np.linalg.norm(first - second) - 2.0, third[0] * third[2]])

    at, step = resolver.state.nodes[arm.free].reshape(-1), 1e-6
    jacobian = np.column_stack(
        [(numbers(at + d) - numbers(at - d)) / (2 * step) for d in step * np.eye(len(at))]
    )
    added = (qp.P - known.P).toarray()
    np.testing.assert_allclose(added[: len(at), : len(at)], 3.0 * jacobian.T @ jacobian, atol=1e-6)
    np.testing.assert_allclose((qp.q - known.q)[: len(at)], 3.0 * jacobian.T @ numbers(at), atol=1e-6)
    assert np.abs(added[len(at) :]).max() == 0.0
    assert [label.name for label in qp.columns] == [label.name for label in known.columns]


@pytest.mark.parametrize(
    "changes", [{}, {"method.tracking": "none"}, {"method.solver": "piqp"}, {"truss.bays": 20}]
)
def test_an_objective_draws_the_arm_as_far_as_its_rows_let_it(changes: dict[str, Any]):
    bays = changes.get("truss.bays", 5)
    near = {"maneuver.waypoint": [{"time": 10.0, "position": [0.1, 0.0, 0.79 * bays]}], "maneuver.steps": 8}
    problem = vq.load_problem("five_bay_free").replace({**changes, **near})
    apart = []
    for objectives in ((), [vq.Objective("place", to_place, weight=10.0)]):
        maneuver = vq.solve(problem, objectives=objectives)
        assert maneuver.status == "solved"
        assert maneuver.certificate.ok, str(maneuver.certificate)
        node = list(vq.Resolver(problem).setup.arm.node_names).index("n2-1")
        apart.append(np.linalg.norm(maneuver.nodes[-1, node] - PLACE))
    assert apart[1] < 0.95 * apart[0]


def test_an_objective_of_a_serial_arm():
    problem, found = vq.Problem.from_dict(SNAKE), []
    name = vq.Resolver(problem).setup.arm.node_names[4]
    for objectives in ((), [vq.Objective("aside", lambda nodes: nodes[name][0] - 0.4, weight=10.0)]):
        maneuver = vq.solve(problem, objectives=objectives)
        assert maneuver.status == "solved"
        assert maneuver.certificate.ok
        found.append(maneuver.nodes[-1, 4, 0])
    assert found[1] > found[0] + 0.01


def test_objectives_without_weight_change_nothing_much():
    problem = vq.load_problem("five_bay_two_cubes").replace({"maneuver.steps": 10})
    known = vq.solve(problem)
    same = vq.solve(problem, objectives=[vq.Objective("none", to_place, weight=0.0)])
    np.testing.assert_allclose(same.nodes, known.nodes, atol=1e-6)


def test_objectives_are_kept_in_retries():
    resolver = vq.Resolver(vq.load_problem("five_bay_free"), objectives=[vq.Objective("place", to_place)])
    other = resolver.again(vq.load_problem("five_bay_free"))
    assert other is not None
    assert other.setup.layout.own is not None
    assert other.setup.layout.own.objectives == resolver.setup.layout.own.objectives


@pytest.mark.parametrize(
    ("objective", "expected"),
    [
        (to_place, "expected vgtm_qp.Objective"),
        (vq.Objective("mine", to_place, weight=-1.0), "has the weight -1.0"),
        (vq.Objective("mine", to_place, weight=float("nan")), "has the weight nan"),
        (vq.Objective("mine", 3), "expected a function"),  # type: ignore[arg-type]
        (vq.Objective("mine", lambda nodes: nodes["n2-9"]), 'did you mean "n2-'),
        (vq.Objective("mine", lambda nodes: "level"), "expected an expression of CasADi"),
        (vq.Objective("mine", lambda nodes: []), "returned nothing"),
        (vq.Objective("mine", lambda nodes: 1 / nodes["n0-1"][2]), "no finite value"),
    ],
)
def test_wrong_objectives_are_refused(objective: Any, expected: str):
    with pytest.raises(vq.PartError, match=re.escape(expected)):
        vq.Resolver(vq.load_problem("five_bay_free"), objectives=[objective])


@pytest.mark.parametrize(
    "method", [{"name": "pseudoinverse"}, {"tracking": "recursive"}, {"name": "curve-pseudoinverse"}]
)
def test_methods_without_a_qp_of_the_arm_refuse_objectives(method: dict[str, Any]):
    problem = vq.load_problem("five_bay_free").replace({"method": method})
    assert vq.Resolver(problem, objectives=[]).step(position=[0.02, 0.0, 4.0]).moved
    with pytest.raises(vq.PartError, match="has no QP of the whole arm"):
        vq.Resolver(problem, objectives=[vq.Objective("place", to_place)])


# Rows.


def outside(center: Any, radius: float, node: str) -> vq.Inequality:
    """A nonlinear row: a node stays outside a ball."""
    return vq.Inequality(f"{node} outside", lambda nodes: ca.norm_2(nodes[node] - np.array(center)) - radius)


def least_outside(maneuver: vq.Maneuver, problem: vq.Problem, center: Any, radius: float, node: str) -> float:
    k = list(vq.Resolver(problem).setup.arm.node_names).index(node)
    return float(np.linalg.norm(maneuver.nodes[:, k] - np.array(center), axis=1).min()) - radius


MOVING = [{"time": 10.0, "position": [0.05, 0.0, 0.1], "rotation_vector": [0.0, 0.05, 0.0]}]


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"method.tracking": "none"},
        {"method.tracking_mode": "elastic"},
        {"end_effector.mode": "elastic"},
        {"method.solver": "piqp"},
        {"truss.base_motion": MOVING},
        {"truss.joint_offset": 0.05},
    ],
)
def test_a_row_is_kept_by_every_state(changes: dict[str, Any]):
    """The ball is in the way that the node takes without the row."""
    problem = vq.load_problem("five_bay_free").replace({"maneuver.steps": 20, **changes})
    free, node, radius = vq.solve(problem), "n3-1", 0.1
    k = list(vq.Resolver(problem).setup.arm.node_names).index(node)
    center = free.nodes[10, k] + [0.0, 0.03, 0.0]
    assert least_outside(free, problem, center, radius, node) < -0.05
    row = outside(center, radius, node)
    maneuver = vq.solve(problem, rows=[row])
    assert maneuver.certificate.ok, str(maneuver.certificate)
    assert maneuver.steps > 5
    assert least_outside(maneuver, problem, center, radius, node) >= -1e-9
    (told,) = maneuver.manifest["own"]["rows"]
    assert told["name"] == f"row: {row.name}"
    assert told["least"] == pytest.approx(least_outside(maneuver, problem, center, radius, node), abs=1e-12)


def test_a_row_that_blocks_is_named_in_the_step_the_stop_and_the_result(tmp_path: Path):
    problem = vq.load_problem("five_bay_free").replace({"maneuver.steps": 20, "method.retries": False})
    row = vq.Inequality("wall", lambda nodes: [0.8 - nodes[f"n5-{k}"][0] for k in (1, 2, 3)])
    maneuver = vq.solve(problem, rows=[row])
    assert maneuver.status == "blocked"
    assert maneuver.certificate.ok
    assert any(name.startswith("row: wall") for name in maneuver.manifest["blocked_by"])
    assert maneuver.manifest["stop"]["kind"] in ("row", "members")
    assert np.all(maneuver.nodes[:, 15:, 0] <= 0.8 + 1e-9)
    maneuver.save(tmp_path / "blocked.npz")
    assert vq.load_result(tmp_path / "blocked.npz").manifest["own"]["rows"][0]["name"] == "row: wall 1"
    assert vq.verify_file(tmp_path / "blocked.npz", problem=problem).ok
    resolver = vq.Resolver(problem, rows=[row])
    for x in (0.4, 0.8, 1.2):
        step = resolver.step(position=[x, 0.0, 3.8], dt=5.0)
    assert step.status is not vq.StepStatus.REACHED
    assert any(name.startswith("row: wall") for name in step.blocked_by)


def test_rows_are_in_the_qp_with_name_and_unit():
    resolver = vq.Resolver(
        vq.load_problem("five_bay_free"),
        rows=[vq.Inequality("height", lambda nodes: nodes["n5-1"][2] - 1.0, unit="ft")],
    )
    qp = resolver.build(position=[0.1, 0.0, 3.9])
    (k,) = [k for k, label in enumerate(qp.rows) if label.name == "row: height"]
    assert (qp.rows[k].kind, qp.rows[k].unit) == ("user's row", "ft")
    row = qp.A[k].toarray()[0]
    (column,) = np.flatnonzero(row)
    assert (qp.columns[column].name, row[column]) == ("node n5-1 z", 1.0)


def test_a_row_of_a_serial_arm_and_an_objective_beside_it():
    problem = vq.Problem.from_dict(SNAKE)
    name = vq.Resolver(problem).setup.arm.node_names[4]
    free = vq.solve(problem)
    start, end = free.nodes[[0, -1], 4, 1]
    way = np.sign(end - start)
    row = vq.Inequality("side", lambda nodes: way * (0.5 * (start + end) - nodes[name][1]))
    drawn = vq.Objective("side", lambda nodes: nodes[name][1] - end - way)
    maneuver = vq.solve(problem, rows=[row], objectives=[drawn])
    assert maneuver.status == "solved"
    assert maneuver.certificate.ok
    short = way * (0.5 * (start + end) - maneuver.nodes[:, 4, 1])
    assert short.min() >= -1e-9
    assert short[-1] < 1e-3


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        (to_place, "expected vgtm_qp.Inequality"),
        (vq.Inequality("mine", 3), "expected a function"),  # type: ignore[arg-type]
        (vq.Inequality("low", lambda nodes: 1.0 - nodes["n5-1"][2]), 'the row "low" is -3'),
        (vq.Inequality("mine", lambda nodes: nodes["m"]), "no node is called 'm'"),
    ],
)
def test_wrong_rows_are_refused(row: Any, expected: str):
    with pytest.raises(vq.PartError, match=re.escape(expected)):
        vq.Resolver(vq.load_problem("five_bay_free"), rows=[row])


# Registration.


@pytest.mark.parametrize(
    ("kind", "name", "part", "expected"),
    [
        ("modul", "mine", tripod, 'did you mean "module"?'),
        ("module", "octahedral", tripod, "is a module of the package"),
        ("module", "a,b", tripod, "a string without commas"),
        ("module", 3, tripod, "a string without commas"),
        ("module", "mine", {}, "expected a function"),
        ("module", "mine", lambda *lengths: {}, "parameters that have names"),
        ("module", "mine", lambda **keys: {}, "parameters that have names"),
        ("curve", "mine", lambda family: {}, "the key is its own"),
    ],
)
def test_what_cannot_be_registered_is_refused(kind: Any, name: Any, part: Any, expected: str):
    with pytest.raises(vq.PartError, match=re.escape(expected)):
        vq.register(kind, name, part)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Install a package with one good part and two bad ones, and return its name."""
    name = "parts_of_a_tester"
    (tmp_path / f"{name}.py").write_text(
        "def single(*, height: float = 1.0):\n"
        "    ground = [[1.0, 0.0, 0.0], [-0.5, 0.8, 0.0], [-0.5, -0.8, 0.0]]\n"
        "    nodes = [{'name': f'g{k}', 'position': p, 'fixed': True} for k, p in enumerate(ground)]\n"
        "    legs = [{'name': f'leg {k}', 'nodes': [f'g{k}', 'top'], 'actuated': True} for k in range(3)]\n"
        "    top = {'name': 'top', 'position': [0.0, 0.0, height]}\n"
        "    return {'node': [*nodes, top], 'member': legs, 'tip': ['top'], 'stroke': [0.5, 3.0]}\n",
        encoding="utf-8",
    )
    info = tmp_path / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8")
    (info / "entry_points.txt").write_text(
        f"[vgtm_qp.modules]\nsingle = {name}:single\nabsent = {name}:other\noctahedral = {name}:single\n"
        f"[vgtm_qp.solvers]\nabsent = {name}:other\n",
        encoding="utf-8",
    )
    monkeypatch.syspath_prepend(tmp_path)
    yield name
    sys.modules.pop(name, None)


def test_an_installed_module_is_found_by_its_entry_point(installed: str):
    assert {"single", "absent"} <= set(part_names("module"))
    assert "octahedral" not in part_names("module")
    keys = {"truss": {"module": "single", "height": 1.2}, "method.tracking": "none", **WAYPOINT}
    changed = {"maneuver.waypoint": [{"time": 2.0, "position": [0.1, 0.0, 1.3]}]}
    problem = vq.load_problem("five_bay_free").replace(keys | changed)
    assert vq.solve(problem).certificate.ok
    assert find_part("module", "single") is not None


def test_an_installed_part_that_cannot_be_imported_is_a_mistake(installed: str):
    with pytest.raises(vq.ProblemError, match=f"cannot be imported from {installed}:other"):
        vq.load_problem("five_bay_free").replace({"truss": {"module": "absent"}})
    with pytest.raises(vq.ProblemError, match=r"method\.solver.*cannot be imported"):
        vq.Resolver(vq.load_problem("five_bay_free").replace({"method.solver": "absent"}))
