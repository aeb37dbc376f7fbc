"""The command line as a person or a script meets it: what is printed where, and every exit code."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vgtm_qp as vq
from vgtm_qp.cli import main
from vgtm_qp.methods import PRESETS

ROOT = Path(__file__).resolve().parents[1]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
COMMAND = [sys.executable, "-c", "import sys; from vgtm_qp.cli import main; sys.exit(main())"]

FREE = """
schema_version = 1
name = "free"
[truss]
module = "octahedral"
bays = 2
stroke = [0.6, 1.5]
[maneuver]
steps = 3
[[maneuver.waypoint]]
time = 3.0
position = {position}
"""

WARNING = (
    "warning: curve.control_vertices = 6: 3 or fewer; the reference curve has 13 degrees of freedom and the arm 6: "
    "7 without effect on the arm, which only cost time\n"
)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "free.toml").write_text(FREE.format(position="[0.1, 0.0, 1.6]"), encoding="utf-8")
    (tmp_path / "far.toml").write_text(FREE.format(position="[9.0, 0.0, 1.6]"), encoding="utf-8")
    return tmp_path


def run(capsys: pytest.CaptureFixture[str], *tokens: str) -> tuple[int, str, str]:
    code = main(tokens)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.mark.smoke
def test_solve_writes_a_verified_result_and_prints_a_table(capsys, folder):
    code, out, err = run(capsys, "solve", "free.toml")
    assert (code, err) == (0, WARNING)
    assert out.startswith("free: solved, verified\n")
    assert "result: free.npz" in out
    assert vq.load_result(folder / "free.npz").certificate.ok


def test_solve_as_json_is_one_document_with_the_keys_of_the_contract(capsys):
    code, out, err = run(capsys, "solve", "free.toml", "--json", "-o", "b.npz")
    summary = json.loads(out)
    assert (code, err) == (0, WARNING)
    assert set(summary) >= {
        "name", "status", "reached", "steps", "bays", "method", "solver", "min_clearance", "max_member_error",
        "max_stroke_violation", "max_rate_violation", "max_tip_error", "step_time", "setup_time",
        "blocked_by", "result",
    }  # fmt: skip
    assert set(summary["step_time"]) >= {"median", "p95", "p99", "phases"}
    assert (summary["status"], summary["result"]) == ("solved", "b.npz")
    assert Path("b.npz").is_file()


def test_options_stand_in_for_those_of_the_problem(capsys):
    code, out, _ = run(
        capsys, "solve", "free.toml", "--steps", "2", "--solver", "osqp", "--method", "qp", "--json"
    )
    summary = json.loads(out)
    assert code == 0
    assert (summary["steps"], summary["solver"]) == (2, "osqp")


@pytest.mark.parametrize("method", ["pseudoinverse", "curve-pseudoinverse"])
def test_a_method_without_a_qp_names_no_solver(capsys, method):
    _, out, _ = run(capsys, "solve", "free.toml", "--method", method)
    assert out.split("method and solver")[1].splitlines()[0].strip() == method
    summary = json.loads(run(capsys, "verify", "free.npz", "--json")[1])
    assert summary["results"][0]["status"] == "infeasible"
    assert vq.load_result("free.npz").summary()["solver"] is None


def test_a_figure_is_drawn(capsys, folder):
    code, out, _ = run(capsys, "solve", "free.toml", "--figure", "frames.png")
    assert code == 0
    assert "figure: frames.png" in out
    assert (folder / "frames.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("tokens", [("solve", "free.toml", "--html", "page.html"), ("view", "free.toml")])
def test_a_missing_extra_is_named_before_any_work(capsys, folder, monkeypatch, tokens):
    monkeypatch.setitem(sys.modules, "viser", None)
    code, out, err = run(capsys, *tokens)
    assert (code, out, err) == (2, "", "vgtm: viser is not installed: pip install 'vgtm-qp[view]'\n")
    assert not (folder / "free.npz").exists()


def test_a_blocked_maneuver_gives_3_and_keeps_what_was_solved(capsys, folder):
    code, out, _ = run(capsys, "solve", "five_bay_blocked_by_wall", "--json")
    summary = json.loads(out)
    assert code == 3
    assert summary["status"] == "blocked"
    assert summary["blocked_by"]
    assert 0.0 < summary["reached"] < 1.0
    assert run(capsys, "verify", summary["result"])[0] == 3


@pytest.mark.smoke
@pytest.mark.parametrize(
    ("tokens", "words"),
    [
        (["slove", "free.toml"], ['did you mean "solve"', "solve, verify, ", "schema, doctor"]),
        (["solve"], ["PROBLEM"]),
        (
            ["solve", "free.toml", "extra", "more"],
            ['more than vgtm solve takes: "extra", "more". Usage: vgtm solve PROBLEM [OPTIONS].'],
        ),
        (["doctor", "x"], ['more than vgtm doctor takes: "x". Usage: vgtm doctor [OPTIONS].']),
        (["export", "a.npz", "b", "--to", "csv"], ["Usage: vgtm export RESULT --to ... [OPTIONS]."]),
        (["solve", "free.toml", "--bogus"], ["--bogus", "--solver", "--figure"]),
        (["solve", "free.toml", "--steps", "many"], ["--steps", "many"]),
        (["solve", "free.toml", "--steps", "0"], ["--steps", "found 0", "integer"]),
        (["solve", "free.toml", "--method", "magic"], ["magic", "qp-none", "curve-pseudoinverse-plain"]),
        (["solve", "free.toml", "--solver", "magic"], ['--solver: found "magic"', '"daqp", "', '"osqp"']),
        (["solve", "free.toml", "-o", "result.txt"], ["--output", ".npz"]),
        (["solve", "free.toml", "-o", "/proc/none/result.npz"], ["--output", "/proc"]),
        (["solve", "free.toml", "-o", "none/result.npz"], ["--output", "none is missing"]),
        (["solve", "free.toml", "-o", "free.toml/result.npz"], ["--output", "free.toml is a file"]),
        (["solve", "free.toml", "--figure", "none/frames.pdf"], ["--figure", "none is missing"]),
        (["solve", "free.toml", "--html", "none/page.html"], ["--html", "none is missing"]),
        (["export", "a.npz", "--to", "csv", "-o", "none/a.csv"], ["--output", "none is missing"]),
        (["bench", "--figure", "none/bars.pdf"], ["--figure", "none is missing"]),
        (["solve", "free.toml", "--figure", "frames.gif"], ["--figure", ".pdf"]),
        (["solve", "none.toml"], ["none.toml", "five_bay_two_cubes"]),
        (["solve", "far.toml"], ["far.toml", "maneuver.waypoint[0].position", "out of any reach"]),
        (["check", "far.toml"], ["far.toml", "maneuver.waypoint[0].position", "out of any reach"]),
        (["verify"], ["RESULT"]),
        (["verify", "free.toml"], ["free.toml: not a whole result file: cut, damaged, or of another kind"]),
        (["verify", "."], [".: a folder; expected a result file, .npz"]),
        (["verify", "none.npz"], ["none.npz"]),
    ],
)
@pytest.mark.parametrize("as_json", [False, True])
def test_wrong_usage_gives_2_and_names_the_choices(capsys, folder, tokens, words, as_json):
    code, out, err = run(capsys, *tokens, *["--json"] * as_json)
    assert code == 2
    assert "Traceback" not in err
    assert all(word in err for word in words)
    if as_json:
        document = json.loads(out)
        said = json.dumps(document, ensure_ascii=False).replace('\\"', '"')
        assert all(word in said for word in words)
    else:
        assert out == ""
    assert not list(folder.glob("*.npz"))
    assert not (folder / "none").exists()


def test_mistakes_of_a_file_are_listed_one_a_line_and_as_data(capsys, folder):
    text = FREE.format(position="[nan, 0.0, 1.6]").replace("bays = 2", "bayz = 2")
    (folder / "wrong.toml").write_text(text, encoding="utf-8")
    code, out, err = run(capsys, "check", "wrong.toml", "--json")
    mistakes = json.loads(out)["mistakes"]
    assert code == 2
    assert {mistake["key"] for mistake in mistakes} == {
        "truss.bayz",
        "maneuver.waypoint[0].position[0]",
    }
    assert err.splitlines() == [
        f"{m['file']}: {m['key']}: found {m['value']}; expected {m['expected']}" for m in mistakes
    ]


@pytest.mark.parametrize("command", ["check", "solve"])
@pytest.mark.parametrize(
    ("table", "key", "value", "words"),
    [
        (
            '[truss]\nlocked = ["B1-1", "B9-1"]',
            "truss.locked[1]",
            '"B9-1"',
            ["6 actuated members B1-1, ", "did you"],
        ),
        ('[truss]\nlocked = ["L1-1"]', "truss.locked[0]", '"L1-1"', ["this one has a fixed length"]),
        (
            '[method]\nsolver = "osqq"\n[truss]',
            "method.solver",
            '"osqq"',
            ['"daqp", "', 'did you mean "osqp"?'],
        ),
    ],
)
def test_mistakes_that_only_the_arm_shows_have_their_place_too(
    capsys, folder, command, table, key, value, words
):
    text = FREE.format(position="[0.1, 0.0, 1.6]").replace("[truss]", table)
    (folder / "wrong.toml").write_text(text, encoding="utf-8")
    code, out, err = run(capsys, command, "wrong.toml", "--json")
    (mistake,) = json.loads(out)["mistakes"]
    assert code == 2
    assert (Path(mistake["file"]).name, mistake["key"], mistake["value"]) == ("wrong.toml", key, value)
    assert all(word in mistake["expected"] for word in words)
    assert err == f"{mistake['file']}: {key}: found {value}; expected {mistake['expected']}\n"


@pytest.mark.smoke
def test_check_describes_the_truss(capsys):
    code, out, _ = run(capsys, "check", "free.toml")
    assert code == 0
    assert "statically determinate: 18 members, 18 coordinates, rank 18" in out
    data = json.loads(run(capsys, "check", "free.toml", "--json")[1])
    assert data["valid"]
    assert [warning["key"] for warning in data["warnings"]] == ["curve.control_vertices"]
    assert data["truss"]["determinacy"]["rank"] == 18
    assert data["truss"]["trackable"] == ["position"]


def test_an_altered_result_gives_4(capsys, folder):
    assert main(["solve", "free.toml"]) == 0
    with np.load("free.npz") as file:
        arrays = dict(file)
    arrays["nodes"][2, 5, 0] += 1e-3
    np.savez_compressed("altered.npz", **arrays)
    code, _, err = run(capsys, "verify", "altered.npz")
    assert code == 4
    assert "altered.npz" in err


def test_a_maneuver_outside_its_tolerances_gives_4(capsys):
    assert run(capsys, "solve", "free.toml")[0] == 0
    maneuver = vq.load_result("free.npz")
    problem = {
        **maneuver.manifest["problem"],
        "truss": {**maneuver.manifest["problem"]["truss"], "rate": 1e-6},
    }
    record = {**maneuver.manifest["arm"], "rate": [1e-6] * len(maneuver.members)}
    replace(maneuver, manifest={**maneuver.manifest, "problem": problem, "arm": record}).save("fast.npz")
    code, out, _ = run(capsys, "verify", "free.npz", "fast.npz", "--json")
    document = json.loads(out)
    assert code == 4
    assert [entry["verified"] for entry in document["results"]] == [True, False]
    assert not document["verified"]


@pytest.mark.smoke
def test_list_and_schema_and_doctor(capsys):
    bundled = vq.bundled_problems()
    assert [entry["name"] for entry in json.loads(run(capsys, "list", "--json")[1])["problems"]] == list(
        bundled
    )
    assert all(name in run(capsys, "list")[1] for name in bundled)
    assert json.loads(run(capsys, "schema")[1]) == vq.problem_schema()
    code, out, _ = run(capsys, "doctor", "--json")
    found = json.loads(out)
    assert code == 0
    assert found["ok"]
    assert "daqp" in found["solvers"]["says"]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert set(found["extras"]) == set(project["optional-dependencies"])


def test_doctor_says_what_fails(capsys, monkeypatch):
    fcl = pytest.importorskip("fcl")
    monkeypatch.setattr(fcl, "distance", lambda *_: 0.7)
    monkeypatch.setenv("VGTM_CC", "none")
    code, out, _ = run(capsys, "doctor")
    assert code == 1
    assert "not in order: fcl" in out
    assert "no C compiler" in out


def test_the_command_line_knows_every_method_by_name(capsys):
    for name in PRESETS:
        code, out, _ = run(capsys, "solve", "free.toml", "--method", name, "--steps", "1", "--json")
        assert code in (0, 4)
        assert json.loads(out)["status"] == ("solved" if code == 0 else "infeasible")
    code, _, err = run(capsys, "solve", "free.toml", "--method", "nonsense")
    assert code == 2
    assert all(name in err for name in PRESETS)


def test_an_internal_error_gives_1_and_one_document(capsys, monkeypatch):
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("by design")

    monkeypatch.setattr("vgtm_qp.problem.load_problem", broken)
    code, out, err = run(capsys, "solve", "free.toml", "--json")
    assert code == 1
    assert "Traceback" in err
    assert "by design" in json.loads(out)["error"]


def test_an_interrupt_between_steps_gives_130_and_keeps_them(capsys, monkeypatch):
    from vgtm_qp.methods import QPResolver

    follow, calls = QPResolver.follow, []

    def interrupted(self, *args, **options):
        calls.append(None)
        if len(calls) == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return follow(self, *args, **options)

    monkeypatch.setattr(QPResolver, "follow", interrupted)
    before = signal.getsignal(signal.SIGINT)
    code, out, err = run(capsys, "solve", "free.toml", "--steps", "8", "--json")
    assert code == 130
    assert "free.npz" in err
    assert json.loads(out)["blocked_by"] == ["interrupted"]
    assert vq.load_result("free.npz").steps == 3
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interrupt_from_outside_gives_130_whatever_it_hits():
    program = (
        "import os, signal, sys, threading; from vgtm_qp.cli import main; "
        "threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT)).start(); sys.exit(main())"
    )
    command = [sys.executable, "-c", program, "solve", "free.toml", "--steps", "500000", "-o", "long.npz"]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 130, done.stderr
    assert "Traceback" not in done.stderr
    assert "interrupted" in done.stderr


def test_a_reader_that_goes_away_is_no_error():
    process = subprocess.Popen(
        [*COMMAND, "schema"], env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    process.stdout.close()
    err = process.stderr.read()
    process.stderr.close()
    assert (process.wait(timeout=60), err) == (0, b"")


def test_help_imports_nothing_heavy():
    heavy = ["casadi", "fcl", "matplotlib", "numpy", "pydantic", "scipy", "trimesh", "vgtm_qp.problem"]
    code = (
        "import sys; from vgtm_qp.cli import main; main(['--help']); "
        f"print([name for name in {heavy} if name in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, check=True
    )
    assert done.stderr.strip() == "[]"
    assert "solve" in done.stdout


@pytest.mark.parametrize("given", [None, "3"])
def test_a_command_holds_blas_to_one_thread_unless_it_is_told_a_number(given):
    environment = {name: value for name, value in ENVIRONMENT.items() if name != "OPENBLAS_NUM_THREADS"}
    environment |= {"OPENBLAS_NUM_THREADS": given} if given else {}
    code = (
        "import os, sys; from vgtm_qp.cli import main; assert 'numpy' not in sys.modules; "
        "main(['schema']); print(os.environ['OPENBLAS_NUM_THREADS'], file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stderr.strip() == (given or "1")


def test_the_package_gives_its_names_and_keeps_the_function_verify():
    from vgtm_qp.verify.check import verify

    assert vq.verify is verify
    assert set(dir(vq)) == {*vq.__all__, "__version__"}
    assert all(getattr(vq, name) is not None for name in vq.__all__)
    with pytest.raises(AttributeError, match="load_problem"):
        vq.no_such_name  # noqa: B018


def test_the_version_is_that_of_the_distribution_or_unknown(monkeypatch):
    import importlib.metadata

    assert vq.__version__ == importlib.metadata.version("vgtm-qp")

    def absent(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", absent)
    assert vq.__version__ == "0+unknown"


@pytest.mark.parametrize(("shell", "code"), [("bash", 0), ("zsh", 0), ("fish", 0), ("tcsh", 2)])
def test_completion_is_installed_for_the_shell_that_is_named(shell, code, tmp_path):
    program = "import sys; from vgtm_qp.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "--install-completion", "--shell", shell]
    environment = {**ENVIRONMENT, "HOME": str(tmp_path)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, "Traceback" in done.stderr) == (code, False), done.stderr
    written = [file for file in tmp_path.rglob("*") if file.is_file() and "vgtm" in file.read_text()]
    assert bool(written) == (code == 0)
