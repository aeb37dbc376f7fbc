"""An arm moves in the same way whatever its size: every length of a problem is multiplied, and the maneuver with it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import vgtm_qp as vq

LENGTHS = {
    *("longeron", "batten", "stroke", "rate", "acceleration", "member_radius", "link_radius", "joint_offset"),
    *(
        "position",
        "tip",
        "center",
        "size",
        "radius",
        "height",
        "velocity",
        "safe",
        "self_safe",
        "influence",
        "margin",
    ),
}
"""Keys whose values are lengths, or lengths per time."""

PROBLEMS = (
    *(
        "octahedral_past_a_cube",
        "double_octahedral_past_a_cube",
        "hexapod_past_a_cube",
        "longeron_past_a_cube",
    ),
    *("tetrahedral_past_a_cube", "five_bay_two_cubes_pointing", "offset_joints_past_a_cube", "moving_base"),
    *("actuator_jams", "five_bay_blocked_by_wall", "b_spline_past_a_cube", "snake_past_a_cube"),
)


def scaled(value: Any, factor: float, key: str = "") -> Any:
    """Return a table of a problem with all lengths multiplied; angles of joints that turn stay."""
    if isinstance(value, dict):
        turns = {"limits", "home", "rate", "acceleration"} if "axis" in value else set()
        return {name: part if name in turns else scaled(part, factor, name) for name, part in value.items()}
    if isinstance(value, list):
        return [scaled(part, factor, key) for part in value]
    return value * factor if key in LENGTHS and isinstance(value, float | int) else value


@pytest.mark.dear
@pytest.mark.parametrize("factor", [1e3, 1e-3])
@pytest.mark.parametrize("name", [*PROBLEMS, "least angle"])
def test_a_larger_or_smaller_arm_moves_in_the_same_way(name, factor):
    table = vq.load_problem(PROBLEMS[0] if name == "least angle" else name).to_dict()
    # Other keys belong to other methods.
    table["method"] = {"name": "qp", "slow_approach": table["method"]["slow_approach"]}
    if name == "least angle":
        # Above what the members that meet would have.
        free = vq.solve(vq.Problem.from_dict(table)).certificate.member_angle.value
        table["clearance"]["minimum_angle"] = free + 0.05
    small, other = (vq.Problem.from_dict(scaled(table, by)) for by in (1.0, factor))
    unit = vq.Resolver(small).setup.arm.unit
    first, second = (vq.solve(each) for each in (small, other))
    assert second.status == first.status
    assert len(second.time) == len(first.time)
    assert np.abs(second.nodes / factor - first.nodes).max() <= 1e-6 * unit
    assert second.reached == pytest.approx(first.reached, abs=1e-6)
    assert second.certificate.failures() == first.certificate.failures()
    stops = [each.manifest["stop"] or {} for each in (first, second)]
    assert stops[0].get("kind") == stops[1].get("kind")


def test_so_it_does_without_a_compiler(monkeypatch):
    monkeypatch.setenv("VGTM_CC", "none")
    test_a_larger_or_smaller_arm_moves_in_the_same_way(PROBLEMS[0], 1e-3)
