"""The CSV file of a path: every wrong cell is named by line and column."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vgtm_qp.errors import ProblemError
from vgtm_qp.problem import load_problem, read_path

PROBLEM = """
schema_version = 1
[truss]
module = "hexapod"
bays = 5
[end_effector]
track = TRACK
[maneuver]
path = "circle.csv"
approach_steps = 5
"""


def test_rows_come_in_their_order_whatever_the_order_of_columns(tmp_path: Path) -> None:
    file = tmp_path / "path.csv"
    file.write_text("\ufefft, x, y, z\r\n0, 1, 2, 3\r\n\r\n0.5, 4, 5, 6e0\r\n", encoding="utf-8")
    table = read_path(file)
    np.testing.assert_array_equal(table.time, [0, 0.5])
    np.testing.assert_array_equal(table.position, [[1, 2, 3], [4, 5, 6]])
    assert table.rotation_vector is None
    file.write_text("rx,ry,rz,z,y,x,t\n7,8,9,3,2,1,0\n")
    table = read_path(file)
    np.testing.assert_array_equal(table.position, [[1, 2, 3]])
    assert table.rotation_vector is not None
    np.testing.assert_array_equal(table.rotation_vector, [[7, 8, 9]])


@pytest.mark.parametrize(
    ("text", "key", "value", "expected"),
    [
        ("", "line 1", "nothing", "the header t,x,y,z"),
        ("t,x,y,z\n", "line 2", "nothing", "at least one row"),
        ("t,x,y\n0,1,2\n", "line 1", '"t,x,y"', "missing: z"),
        ("t,x,y,z,rx\n0,1,2,3,4\n", "line 1", '"t,x,y,z,rx"', "missing: ry, rz"),
        ("t,x,y,w\n0,1,2,3\n", "line 1, column 4", '"w"', "the header"),
        ("t,x,y,z,z\n0,1,2,3,3\n", "line 1, column 5", '"z"', "once"),
        ("0,1,2,3\n", "line 1", '"0,1,2,3"', "the header"),
        ("t,x,y,z\n0,1,2\n", "line 2", "3 cells", "4 cells"),
        ("t,x,y,z\n0,1,a,3\n", "line 2, column y", '"a"', "a finite number"),
        ("t,x,y,z\n0,1,,3\n", "line 2, column y", '""', "a finite number"),
        ("t,x,y,z\n0,1,nan,3\n", "line 2, column y", '"nan"', "a finite number"),
        ("t,x,y,z\n0,-inf,2,3\n", "line 2, column x", '"-inf"', "a finite number"),
        ("t,x,y,z\n-1,1,2,3\n", "line 2, column t", "-1", "0 or more"),
        ("t,x,y,z\n0,1,2,3\n\n0,1,2,3\n", "line 4, column t", "0", "after that of the row before"),
    ],
)
def test_each_wrong_cell_is_named(tmp_path: Path, text: str, key: str, value: str, expected: str) -> None:
    file = tmp_path / "path.csv"
    file.write_text(text)
    with pytest.raises(ProblemError) as raised:
        read_path(file)
    (mistake,) = raised.value.mistakes
    assert (mistake.key, mistake.value) == (key, value)
    assert expected in mistake.expected
    assert raised.value.source == str(file)


def test_files_that_are_no_text(tmp_path: Path) -> None:
    file = tmp_path / "path.csv"
    file.write_bytes(b"t,x,y,z\n0,1,2,\xff\n")
    with pytest.raises(ProblemError, match="UTF-8"):
        read_path(file)
    for wrong in (tmp_path, tmp_path / "none.csv"):
        with pytest.raises(ProblemError, match="a CSV file"):
            read_path(wrong)


def test_wrong_cells_come_with_the_mistakes_of_the_problem(tmp_path: Path) -> None:
    (tmp_path / "circle.csv").write_text("t,x,y,z\n0,1,a,3\n1,b,2,3\n")
    file = tmp_path / "p.toml"
    file.write_text(PROBLEM.replace("TRACK", '["positon"]'))
    with pytest.raises(ProblemError) as raised:
        load_problem(file)
    assert [mistake.key for mistake in raised.value.mistakes] == [
        "end_effector.track[0]",
        'maneuver.path "circle.csv", line 2, column y',
        'maneuver.path "circle.csv", line 3, column x',
    ]


def test_a_tracked_direction_needs_its_columns(tmp_path: Path) -> None:
    file = tmp_path / "p.toml"
    file.write_text(PROBLEM.replace("TRACK", '["position", "orientation"]'))
    (tmp_path / "circle.csv").write_text("t,x,y,z\n0,1,2,3\n")
    with pytest.raises(ProblemError, match="the columns t,x,y,z,rx,ry,rz"):
        load_problem(file)
    (tmp_path / "circle.csv").write_text("t,x,y,z,rx,ry,rz\n0,1,2,3,0,0,0\n")
    assert load_problem(file).maneuver.approach_steps == 5  # type: ignore[union-attr]
    (tmp_path / "circle.csv").rename(tmp_path / "circel.csv")
    with pytest.raises(ProblemError, match=r'maneuver.path: .*did you mean "circel.csv"'):
        load_problem(file)
