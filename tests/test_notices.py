"""What the package tells beside results: warnings are logged, the command says each once; durations are in words."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from vgtm_qp.cli import main
from vgtm_qp.notices import spoken, telling

ROOT = Path(__file__).resolve().parents[1]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1", "VGTM_CC": "none"}
FREER = """
import vgtm_qp as vq
problem = vq.load_problem("five_bay_free").replace({"truss.bays": 2})
problem = problem.replace({"curve.control_vertices": 7, "maneuver.waypoint": [{"time": 1.0, "position": [0, 0, 1.6]}]})
vq.Resolver(problem)
"""


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.0, "0 ms"),
        (0.000818, "0.818 ms"),
        (0.25, "250 ms"),
        (0.9996, "1.0 s"),
        (7.43, "7.4 s"),
        (59.97, "1 min 0 s"),
        (125.2, "2 min 5 s"),
        (3599.7, "1 h 0 min"),
        (3780.0, "1 h 3 min"),
    ],
)
def test_durations_are_told_as_people_read_them(seconds, words):
    assert spoken(seconds) == words


def test_each_warning_is_told_once_and_in_one_line():
    told: list[str] = []
    logger = logging.getLogger("vgtm_qp.step.checks")
    with telling(told.append):
        for _ in range(2):
            logger.warning("%s is\n  doubtful", "this")
        logger.info("not for everybody")
        try:
            raise IndexError("by design")
        except IndexError:
            logger.exception("a widget failed")
    logger.warning("afterwards")
    assert told[:2] == ["warning: this is doubtful", "error: a widget failed"]
    assert told[2].startswith("Traceback")
    assert told[2].endswith("IndexError: by design")
    assert len(told) == 3


def test_a_program_without_settings_for_logging_sees_warnings_on_stderr_and_one_with_them_where_it_wants():
    plain = subprocess.run(
        [sys.executable, "-c", FREER], env=ENVIRONMENT, capture_output=True, text=True, check=True
    )
    assert plain.stderr.startswith("curve.control_vertices = 7: ")
    assert (plain.stderr.count("\n"), plain.stdout) == (1, "")
    quiet = "import logging; logging.getLogger('vgtm_qp').setLevel(logging.ERROR)" + FREER
    done = subprocess.run(
        [sys.executable, "-c", quiet], env=ENVIRONMENT, capture_output=True, text=True, check=True
    )
    assert (done.stderr, done.stdout) == ("", "")


@pytest.mark.parametrize(
    ("category", "line"),
    [(UserWarning, "warning: by design\n"), (FutureWarning, "warning: by design (FutureWarning, ")],
)
def test_the_command_tells_warnings_of_other_libraries_in_one_line_too(monkeypatch, capsys, category, line):
    def warn() -> dict[str, Path]:
        warnings.warn("by\ndesign", category, stacklevel=2)
        return {}

    monkeypatch.setattr("vgtm_qp.problem.bundled_problems", warn)
    assert main(["list", "--json"]) == 0
    err = capsys.readouterr().err
    assert err.startswith(line)
    assert err.count("\n") == 1
