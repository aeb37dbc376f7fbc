"""Problem files with random mistakes through the whole command: exit 2 and a message, or an honest outcome."""

from __future__ import annotations

import json
import re

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from vgtm_qp.cli import main

TEXT = """schema_version = 1
name = "two bays"
[truss]
module = "octahedral"
bays = 2
stroke = [0.6, 1.5]
rate = 0.5
member_radius = 0.03
[curve]
family = "bezier"
control_vertices = 4
[end_effector]
track = ["position"]
[maneuver]
steps = 2
[[maneuver.waypoint]]
time = 2.0
position = [0.1, 0.0, 1.6]
[[obstacle]]
name = "cube"
shape = "box"
center = [1.5, 0.0, 1.0]
size = 0.5
[clearance]
safe = 0.05
influence = 0.5
[method]
retries = false
"""

VALUES = [
    "-1",
    "0",
    "1",
    "nan",
    "inf",
    "-inf",
    '""',
    '"cube"',
    "[]",
    "[1.0]",
    "{}",
    "true",
    "1e300",
    "1e-300",
]
LINES = TEXT.splitlines()


@st.composite
def altered(draw):
    """Return the file with some lines dropped, doubled, cut, or given another value."""
    lines = list(LINES)
    for _ in range(draw(st.integers(1, 3))):
        k = draw(st.integers(0, len(lines) - 1))
        kind = draw(st.sampled_from(["drop", "double", "cut", "value", "value", "value", "key"]))
        if kind == "drop":
            del lines[k]
        elif kind == "double":
            lines.insert(k, lines[k])
        elif kind == "cut":
            lines[k] = lines[k][: draw(st.integers(0, len(lines[k])))]
        elif kind == "value" and "=" in lines[k]:
            lines[k] = lines[k].split("=")[0] + "= " + draw(st.sampled_from(VALUES))
        elif kind == "key":
            lines[k] = re.sub(r"[a-z]", "x", lines[k], count=1)
    return "\n".join(lines)


@settings(
    max_examples=120,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(altered())
def test_an_altered_problem_file_is_refused_with_a_message_or_solved_honestly(tmp_path, capsys, text):
    file = tmp_path / "altered.toml"
    file.write_text(text, encoding="utf-8")
    code = main(["solve", str(file), "--json", "-o", str(tmp_path / "altered.npz")])
    out, err = capsys.readouterr()
    assert code in (0, 2, 3), (code, err, text)
    if code == 2:
        assert "altered.toml" in err
        assert "expected" in err
        assert "Traceback" not in err
    else:
        summary = json.loads(out)
        assert summary["status"] == ("solved" if code == 0 else "blocked")
        assert summary["max_member_error"] <= 1e-9


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
def test_numbers_that_are_none_are_refused_wherever_they_stand(tmp_path, capsys, value):
    for k, line in enumerate(LINES):
        if re.search(r"= \[?-?\d", line) and "version" not in line:
            wrong = [*LINES[:k], re.sub(r"-?\d+(\.\d+)?", value, line, count=1), *LINES[k + 1 :]]
            file = tmp_path / "altered.toml"
            file.write_text("\n".join(wrong), encoding="utf-8")
            assert main(["check", str(file)]) == 2, line
            assert "expected" in capsys.readouterr().err
