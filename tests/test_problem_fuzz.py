"""Mutations of valid problems give a problem or its mistakes, and nothing else."""

from __future__ import annotations

import copy
import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from problem_texts import ARM, GRAPH, VALID

from vgtm_qp.errors import ProblemError
from vgtm_qp.problem import Problem, load_problem

PATH = """
schema_version = 1
[truss]
module = "tetrahedral"
bays = 4
actuated = [1, 2]
base_motion = [{ time = 1.0, position = [0, 0, 1] }]
locked = ["B1-1", { member = "D1-1", time = 3.0 }]
[curve]
family = "beta-spline"
bias = 1.5
control_vertex_goals = [{ index = 2, position = [0, 0, 1] }]
[maneuver]
kind = "path"
waypoint = [{ time = 1.0, position = [0, 0, 1] }]
[[obstacle]]
name = "ball"
shape = "sphere"
center = [3, 0, 0]
radius = 1.0
[[obstacle]]
name = "can"
shape = "cylinder"
center = [-3, 0, 0]
radius = 1
height = 2
[[obstacle]]
name = "part"
shape = "mesh"
file = "part.stl"
"""
DOCUMENTS = [tomllib.loads(text) for text in (VALID, GRAPH, ARM, PATH)]

keys = st.sampled_from(
    [
        "name",
        "shape",
        "size",
        "module",
        "bays",
        "kind",
        "path",
        "waypoint",
        "family",
        "node",
        "<box>",
        "",
        "a.b",
        "é",
    ]
)
scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.sampled_from([10**400, 2**63, 0, -1]),
    st.floats(),
    st.text(max_size=8),
    st.sampled_from(["graph", "plate", "mesh", "box", "deployment", "b-spline", "{x}", "\x00", "../.."]),
    st.dates(),
)
values = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(keys, inner, max_size=3),
    max_leaves=8,
)


def places(data: Any, here: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    inner = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    return [here, *(place for key, value in inner for place in places(value, (*here, key)))]


@st.composite
def mutated(draw: st.DrawFn) -> Any:
    data = copy.deepcopy(draw(st.sampled_from(DOCUMENTS)))
    for _ in range(draw(st.integers(1, 3))):
        found = [place for place in places(data) if place]
        if not found:
            break
        *outer, last = draw(st.sampled_from(found))
        table = data
        for key in outer:
            table = table[key]
        change = draw(st.sampled_from(["delete", "retype", "rename", "add", "repeat", "swap"]))
        if change == "delete":
            del table[last]
        elif change == "retype":
            table[last] = draw(values)
        elif change == "rename" and isinstance(table, dict):
            table[draw(keys | st.just(str(last) + "s"))] = table.pop(last)
        elif change == "add" and isinstance(table[last], dict):
            table[last][draw(keys)] = draw(values)
        elif change == "repeat" and isinstance(table, list):
            table.append(copy.deepcopy(table[last]))
        else:
            table[last] = [table[last]]
    return data


def attempt(read: Callable[[], Problem]) -> Problem | ProblemError:
    try:
        return read()
    except ProblemError as error:
        return error


@given(mutated())
@settings(max_examples=600, deadline=None)
def test_a_mutated_problem_is_read_or_refused(data: Any) -> None:
    answer = attempt(lambda: Problem.from_dict(data))
    if isinstance(answer, Problem):
        written = json.loads(json.dumps(answer.to_dict(), allow_nan=False))
        assert Problem.from_dict(written) == answer
        return
    assert answer.mistakes
    for mistake in answer.mistakes:
        assert mistake.key
        assert mistake.value
        assert mistake.expected
        assert "\n" not in str(mistake)
        assert "pydantic" not in str(mistake)
        assert len(mistake.value) < 500


@pytest.fixture
def problem_file(tmp_path: Path) -> Path:
    return tmp_path / "fuzz.toml"


@given(st.data())
@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_file_with_mutated_bytes_is_read_or_refused(problem_file: Path, data: st.DataObject) -> None:
    raw = bytearray(data.draw(st.sampled_from([VALID, GRAPH, PATH])).encode())
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(raw)))
        stop = start + data.draw(st.integers(0, 20))
        raw[start:stop] = data.draw(
            st.binary(max_size=4)
            | st.sampled_from([b"[", b"]", b'"', b"\n", b"=", b"{", b"#", b"-", b"e9", b"nan"])
        )
    problem_file.write_bytes(raw)
    answer = attempt(lambda: load_problem(problem_file))
    if isinstance(answer, ProblemError):
        assert answer.source == str(problem_file)
        assert answer.mistakes
