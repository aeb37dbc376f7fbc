"""The bundled problem files, their schema, and problems made in Python."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from vgtm_qp.errors import ProblemError
from vgtm_qp.problem import Problem, bundled_problems, load_problem, problem_schema
from vgtm_qp.problem.goal import PathManeuver, WaypointManeuver
from vgtm_qp.problem.obstacle import Box
from vgtm_qp.problem.shape import BezierCurve, BSplineCurve
from vgtm_qp.problem.truss import ModuleTruss

PROBLEMS = Path(__file__).parents[1] / "problems"
MANEUVER: dict[str, Any] = {"waypoint": [{"time": 10, "position": [1, 0, 3]}]}
TRUSS: dict[str, Any] = {"module": "octahedral", "bays": 5}


def validator() -> jsonschema.Draft202012Validator:
    schema = problem_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def test_the_schema_file_is_up_to_date() -> None:
    written = (PROBLEMS / "problem.schema.json").read_text()
    assert written == json.dumps(problem_schema(), indent=2) + "\n", "write it again: vgtm schema"


@pytest.mark.smoke
@pytest.mark.parametrize("file", sorted(PROBLEMS.glob("*.toml")), ids=lambda file: file.stem)
def test_each_problem_file_fits_the_schema_and_the_models(file: Path) -> None:
    text = file.read_text()
    assert text.startswith("#:schema ./problem.schema.json\n")
    validator().validate(tomllib.loads(text))
    problem = load_problem(file)
    assert problem.source == file
    bundled = load_problem(file.stem)
    assert bundled.source.read_text() == text
    assert bundled.name == problem.name
    data = problem.to_dict()
    validator().validate(data)
    assert Problem.from_dict(json.loads(json.dumps(data)), source=file) == problem


@pytest.mark.smoke
def test_the_bundled_problems_are_those_of_the_folder() -> None:
    assert {"five_bay_two_cubes", "five_bay_two_cubes_pointing", "ten_bay_round_a_cube"} <= set(
        bundled_problems()
    )
    assert list(bundled_problems()) == sorted(file.stem for file in PROBLEMS.glob("*.toml"))


def test_no_obstacle_of_a_bundled_problem_touches_the_arm_at_home() -> None:
    for name in bundled_problems():
        problem = load_problem(name)
        if not (isinstance(problem.truss, ModuleTruss) and problem.truss.module == "octahedral"):
            continue
        radius = problem.truss.batten / math.sqrt(3) + problem.truss.member_radius + problem.clearance.safe
        for box in problem.obstacle:
            if isinstance(box, Box) and not any(box.rotation_vector):
                gap = np.maximum(np.abs(box.center[:2]) - np.array(box.size[:2]) / 2, 0)
                assert np.linalg.norm(gap) > radius, name


def test_the_schema_refuses_what_the_models_refuse() -> None:
    for change in (
        {"truss": {"module": "octahedral"}},
        {"truss": {**TRUSS, "bayz": 3}},
        {"truss": {**TRUSS, "stroke": [1]}},
        {"obstacle": [{"name": "a", "shape": "sphere", "center": [0, 0, 9], "size": 1}]},
        {"method": {"tracking": "paralel"}},
        {"schema_version": 2},
    ):
        data = {"schema_version": 1, "truss": TRUSS, "maneuver": MANEUVER}
        assert validator().is_valid(data)
        assert not validator().is_valid(data | change)
        with pytest.raises(ProblemError):
            Problem.from_dict(data | change)


def test_a_problem_in_python_from_tables_keywords_and_arrays() -> None:
    problem = Problem(
        truss=ModuleTruss(module="hexapod", bays=3),
        maneuver={"waypoint": [{"time": 1, "position": np.array([0.1, 0, 2.5])}]},
        obstacle=[Box(name="b", shape="box", center=(2, 0, 1), size=0.5)],
    )
    assert problem == Problem.from_dict(problem.to_dict())
    assert problem.source is None
    assert isinstance(problem.curve, BezierCurve)
    assert isinstance(problem.maneuver, WaypointManeuver)
    assert problem.maneuver.waypoint[0].position == (0.1, 0.0, 2.5)
    assert problem.obstacle[0].size == (0.5, 0.5, 0.5)  # type: ignore[union-attr]
    with pytest.raises(ProblemError, match="immutable"):
        problem.name = "other"


def test_the_tables_of_each_kind() -> None:
    spline = Problem(truss=TRUSS, maneuver=MANEUVER, curve={"family": "b-spline", "degree": 2})
    assert isinstance(spline.curve, BSplineCurve)
    locked = Problem(truss={**TRUSS, "locked": ["B1-1", {"member": "B2-1", "time": 5}]}, maneuver=MANEUVER)
    assert locked.truss is not None
    assert [(lock.member, lock.time) for lock in locked.truss.locked] == [("B1-1", 0.0), ("B2-1", 5.0)]
    data = {"schema_version": 1, "truss": {**TRUSS, "locked": ["B1-1"]}, "maneuver": MANEUVER}
    for problem in (spline, locked):
        validator().validate(problem.to_dict())
    validator().validate(data)


def test_replacing_values_checks_them_again() -> None:
    problem = load_problem("five_bay_two_cubes")
    changed = problem.replace({"method.solver": "osqp", "maneuver.steps": 20})
    assert (changed.method.solver, changed.maneuver.steps) == ("osqp", 20)  # type: ignore[union-attr]
    assert changed.source == problem.source
    assert problem.method.solver == "daqp"
    assert changed.replace({"method.solver": "daqp", "maneuver.steps": 50}) == problem
    with pytest.raises(ProblemError, match=r"maneuver.steps: found 0"):
        problem.replace({"maneuver.steps": 0})
    with pytest.raises(ProblemError, match=r"method.solvr.*did you mean \"solver\""):
        problem.replace({"method.solvr": "osqp"})


def test_a_later_check_names_the_place() -> None:
    problem = load_problem("five_bay_two_cubes")
    mistake = problem.mistake(("obstacle", 1, "center"), "a place outside the arm")
    assert str(mistake) == (
        'obstacle[1] ("left cube").center: found '
        f"{list(problem.obstacle[1].center)}; expected a place outside the arm"
    )


def test_a_moved_result_can_be_read_without_the_files_of_its_problem(tmp_path: Path) -> None:
    data = {"truss": TRUSS, "maneuver": {"path": "gone.csv"}}
    problem = Problem.from_dict(data, source=tmp_path / "p.toml")
    assert isinstance(problem.maneuver, PathManeuver)
    assert problem.maneuver.path == str(tmp_path / "gone.csv")
    assert Problem.from_dict(problem.to_dict(), source=tmp_path / "p.toml") == problem
    with pytest.raises(ProblemError, match="a file that exists"):
        Problem.from_dict(data, source=tmp_path / "p.toml", check_files=True)


def test_reading_a_problem_imports_nothing_heavy() -> None:
    code = (
        "import sys, vgtm_qp.problem as p; p.load_problem('five_bay_two_cubes');"
        "print([m for m in ('casadi', 'scipy', 'fcl', 'qpsolvers', 'trimesh') if m in sys.modules])"
    )
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PROBLEMS.parent
    )
    assert run.stdout.strip() == "[]"
