"""A change of the package's inside changes no state: cases of every kind against states on record."""

from __future__ import annotations

import pytest
from recorded_states import CASES, PROBLEMS, Recording, differences, load, record


@pytest.fixture(scope="module")
def recorded() -> dict[str, Recording]:
    return load()


def test_each_bundled_problem_is_a_case():
    assert {f"bundled {path.stem}" for path in PROBLEMS.glob("*.toml")} <= set(CASES)


def test_each_case_is_on_record(recorded):
    assert set(recorded) == set(CASES)


@pytest.mark.parametrize("name", CASES)
def test_states_are_those_on_record(name, recorded):
    lines = differences(CASES[name], recorded[name], record(CASES[name]))
    assert not lines, "\n".join([name, *lines])


def test_what_differs_is_found(recorded):
    name = "bundled five_bay_free"
    there = recorded[name]
    nodes = there.arrays["nodes"].copy()
    nodes[2, 4, 1] += 2e-9
    moved = Recording({**there.arrays, "nodes": nodes}, there.facts)
    assert not differences(CASES[name], there, there)
    assert differences(CASES[name], there, moved)[0].startswith("nodes[2, 4, 1] differs by 2e-09")
    ended = Recording(there.arrays, {**there.facts, "status": "blocked"})
    assert differences(CASES[name], there, ended) == ["status: 'blocked', on record 'solved'"]
