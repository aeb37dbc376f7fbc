"""What the package tells beside results: warnings are logged, the command says each once; durations are in words."""

from __future__ import annotations

import io
import logging
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

import vgtm_qp as vq
from vgtm_qp.cli import main
from vgtm_qp.cli.output import bar
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


class Terminal(io.StringIO):
    """A terminal that keeps what is drawn on it."""

    def isatty(self) -> bool:
        return True


def terminal_for(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """Put a terminal in the place of stderr; a fixture's would be replaced by what pytest captures."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "200")
    for name in ("NO_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(name, raising=False)
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    return terminal


def test_what_takes_long_shows_a_bar_on_a_terminal_until_it_is_done(tmp_path, monkeypatch, capsys):
    terminal = terminal_for(monkeypatch)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("VGTM_CC", "none")
    solve = ["solve", "five_bay_free", "--steps", "3", "--html", "page.html"]
    pytest.importorskip("viser")
    assert main(solve) == 0
    drawn = terminal.getvalue()
    phases = ("set-up", "verifying", "page")
    assert all(f"five-bay arm, free: {phase}" in drawn for phase in phases)
    assert "five-bay arm, free \x1b" in drawn
    assert [name for name in ("result", "html") if f"{name}: " in capsys.readouterr().out]
    for tokens, word in (
        (["export", "five_bay_free.npz", "--to", "gif"], "five_bay_free.gif: writing"),
        (["export", "five_bay_free.npz", "--to", "csv"], "five_bay_free.csv: writing"),
        (["certify", "five_bay_free", "five_bay_free.csv"], "five_bay_free.csv: certifying"),
        (["verify", "five_bay_free.npz"], "five_bay_free.npz: verifying"),
        (["check", "five_bay_free"], "five-bay arm, free: checking"),
        (["study", "figure4", "--short"], "Figure 4"),
    ):
        assert main(tokens) == 0
        assert word in terminal.getvalue()


def test_the_bench_names_the_scene_on_its_bar_and_in_lines_elsewhere(monkeypatch):
    terminal = terminal_for(monkeypatch)

    def measured(scenes, *_: object, progress, **__: object) -> dict[str, object]:
        for scene in scenes:
            progress(scene)
        raise vq.GoalError("enough")

    monkeypatch.setattr("vgtm_qp.bench.report.measure", measured)
    tokens = ["bench", "--bays", "5", "6", "--tracking", "exact", "--distance", "exact"]
    assert main(tokens) == 2
    assert "bench: " in terminal.getvalue()
    assert "1/2" in terminal.getvalue()
    assert not re.search(r"^[12]/2 ", terminal.getvalue(), re.MULTILINE)
    told = io.StringIO()
    monkeypatch.setattr(sys, "stderr", told)
    assert main(tokens) == 2
    assert [line[:4] for line in told.getvalue().splitlines()[:2]] == ["1/2 ", "2/2 "]
    assert "\x1b" not in told.getvalue()


def test_a_bar_says_how_long_it_takes_in_words(monkeypatch):
    terminal = terminal_for(monkeypatch)
    clock = iter(np.arange(0.0, 1e6, 25.0))
    monkeypatch.setattr("rich.console.monotonic", lambda: next(clock))
    with bar("things", shown=True, counted=True) as advance:
        for done in range(4):
            advance(done, 4)
    assert re.search(r"\d+ min \d+ s", terminal.getvalue())
    assert "0:0" not in terminal.getvalue()


def test_no_bar_is_drawn_where_nobody_looks(monkeypatch):
    terminal = terminal_for(monkeypatch)
    with bar("things", shown=False) as advance:
        advance(1, 2)
    told = io.StringIO()
    monkeypatch.setattr(sys, "stderr", told)
    with bar("things", shown=True) as advance:
        advance(1, 2)
    assert (terminal.getvalue(), told.getvalue()) == ("", "")
