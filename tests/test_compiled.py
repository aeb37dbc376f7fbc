"""Compiled kernels and their cache."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import vgtm_qp as vq
from vgtm_qp.builder import source_of
from vgtm_qp.compiled import Kernel, compiler, finish_compiling, stop_compilers
from vgtm_qp.maneuver.plan import make_plan

needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C compiler")


def _square() -> ca.Function:
    x = ca.SX.sym("x")
    return ca.Function("square", [x], [x * x])


def _value(kernel: Kernel) -> float:
    kernel.inputs[0][:] = 3.0
    kernel()
    return float(kernel.outputs[0][0])


@needs_compiler
def test_a_library_that_cannot_be_loaded_is_compiled_again(tmp_path, monkeypatch):
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path))
    assert Kernel(_square()).compile()
    (library,) = tmp_path.glob("*.so")
    library.unlink()
    library.write_bytes(b"cut short")
    kernel = Kernel(_square())
    assert kernel.compile()
    assert _value(kernel) == 9.0


@needs_compiler
def test_where_the_cache_is_no_folder_the_virtual_machine_serves(tmp_path, monkeypatch):
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path / "file" / "cache"))
    (tmp_path / "file").write_text("in the way")
    kernel = Kernel(_square())
    assert not kernel.compile()
    assert _value(kernel) == 9.0


@needs_compiler
@pytest.mark.parametrize("as_given", ["{cc} -O1", "'{cc}' -DWANTED=1 -O1"])
def test_the_compiler_may_have_flags(tmp_path, monkeypatch, as_given):
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path / "cache"))
    found = shlex.split(compiler() or "")[0]
    monkeypatch.setenv("VGTM_CC", as_given.format(cc=found))
    assert shlex.split(compiler() or "") == shlex.split(as_given.format(cc=found))
    kernel = Kernel(_square())
    assert kernel.compile()
    assert _value(kernel) == 9.0


@needs_compiler
@pytest.mark.parametrize("as_given", ["{cc}", "'{cc}' -DWANTED=1"])
def test_the_folder_of_the_compiler_may_have_a_space(tmp_path, monkeypatch, as_given):
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path / "a cache"))
    wrapper = tmp_path / "a folder" / "cc"
    wrapper.parent.mkdir()
    # The wrapper tells that it ran.
    wrapper.write_text(f'#!/bin/sh\necho ran >> "{tmp_path / "ran"}"\nexec {compiler()} "$@"\n')
    wrapper.chmod(0o755)
    monkeypatch.setenv("VGTM_CC", as_given.format(cc=wrapper))
    kernel = Kernel(_square())
    assert kernel.compile()
    assert _value(kernel) == 9.0
    assert (tmp_path / "ran").exists()


@needs_compiler
def test_code_that_has_not_the_values_of_its_function_is_not_used(tmp_path, monkeypatch, caplog):
    """The compiler of this test reads another number than was written, as one was seen to copy constants wrongly."""
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path / "cache"))
    wrapper = tmp_path / "cc"
    wrapper.write_text(f'#!/bin/sh\nexec sed "s/3.75/3.76/" | {compiler()} "$@"\n')
    wrapper.chmod(0o755)
    monkeypatch.setenv("VGTM_CC", str(wrapper))
    right = Kernel(_long("right", 3.5))
    assert right.compile()
    assert not caplog.text
    wrong = Kernel(_long("wrong", 3.75))
    assert not wrong.compile()
    assert f"{wrapper} made code that has wrong values" in caplog.text
    wrong.inputs[0][:] = right.inputs[0][:] = 0.7
    wrong()
    right()
    assert np.allclose(wrong.outputs[0] / 3.75, right.outputs[0] / 3.5, rtol=1e-12)


@needs_compiler
def test_rounding_that_grows_to_as_much_as_the_values_is_no_fault(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path / "cache"))
    x = ca.SX.sym("x", 3)
    y = x
    for _ in range(48):
        y = ca.vertcat(y[1], y[2], ca.sin(20.0 * y[0] + 0.1 * y[1]))
    assert Kernel(ca.Function("steep", [x], [y])).compile()
    assert not caplog.text


@pytest.mark.parametrize("as_given", ["", "none", "  ", "no-such-compiler -m64", "'cc"])
def test_without_a_compiler_by_that_name_the_virtual_machine_serves(monkeypatch, as_given):
    monkeypatch.setenv("VGTM_CC", as_given)
    assert compiler() is None
    assert _value(Kernel(_square())) == 9.0


def _long(name: str, scale: float) -> ca.Function:
    """A function of some hundred lines, and one that maps it."""
    x = ca.SX.sym("x", 40)
    y = ca.vertcat(*[ca.sqrt(1.0 + x[k] ** 2) * ca.fmax(x[k - 1], 0.1) + ca.sin(x[k]) for k in range(40)])
    inner = ca.Function(f"inner_{name}", [x], [y])
    z = ca.MX.sym("z", 40, 3)
    return ca.Function(name, [z], [scale * inner.map(3)(z)])


@needs_compiler
def test_what_two_kernels_share_is_compiled_once(tmp_path, monkeypatch):
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path))
    kernels = [Kernel(_long(name, scale)) for name, scale in (("one", 1.0), ("other", 2.0))]
    assert all(kernel.compile() for kernel in kernels)
    assert len(list(tmp_path.glob("*.so"))) == 2
    assert len(list(tmp_path.glob("*.o"))) == 1
    interpreted = Kernel(_long("one", 1.0), compiled=False)
    values = np.linspace(-1.0, 2.0, 120)
    for kernel in (*kernels, interpreted):
        kernel.inputs[0][:] = values
        kernel()
    np.testing.assert_allclose(kernels[0].outputs[0], interpreted.outputs[0], atol=1e-15)
    np.testing.assert_allclose(kernels[1].outputs[0], 2.0 * interpreted.outputs[0], atol=1e-15)


@needs_compiler
def test_long_texts_are_compiled_for_little_time_and_give_the_same(tmp_path, monkeypatch, rng):
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path))
    a, b = ca.MX.sym("a", 4, 4), ca.MX.sym("b", 4, 4)
    product = a
    for k in range(300):
        product = 0.25 * product @ b + ca.fmin(a + k, b)
    function = ca.Function("product", [a, b], [product])
    kernel = Kernel(function)
    assert len(source_of(function)) > 100_000
    assert kernel.compile()
    for array in kernel.inputs:
        array[:] = rng.uniform(-1.0, 1.0, size=16)
    kernel()
    first, second = (array.reshape(4, 4).T for array in kernel.inputs)
    wanted = first
    for k in range(300):
        wanted = 0.25 * wanted @ second + np.minimum(first + k, second)
    np.testing.assert_allclose(kernel.outputs[0].reshape(4, 4).T, wanted, rtol=1e-12)


@pytest.mark.smoke
def test_arrays_bound_before_the_first_call_are_those_that_are_used(tmp_path, monkeypatch):
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path))
    kernel = Kernel(_square())
    source, result = np.array([4.0]), np.zeros(1)
    kernel.bind_input(0, source)
    kernel.bind_output(0, result)
    kernel()
    assert result[0] == 16.0
    assert kernel.outputs[0] is result


@pytest.mark.smoke
@needs_compiler
def test_finishing_leaves_nothing_to_wait_for(tmp_path, monkeypatch):
    cache = tmp_path / "cache"
    monkeypatch.setenv("VGTM_CACHE", str(cache))
    kernel, unused = Kernel(_long("awaited", 3.0)), Kernel(_long("unused", 3.0))
    kernel()
    finish_compiling()
    assert list(cache.glob("awaited-*.so"))
    # With a file in the place of the cache nothing could be compiled or loaded any more.
    shutil.rmtree(cache)
    cache.write_text("in the way")
    kernel()
    assert kernel.is_compiled
    assert not unused.is_compiled


@needs_compiler
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_forked_process_does_not_wait_for_the_compilers_of_its_parent(tmp_path, monkeypatch):
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path))
    kernel = Kernel(_long("forked", 1.5))
    child = os.fork()
    if child == 0:
        os._exit(0 if kernel.compile() else 1)
    assert os.waitpid(child, 0)[1] == 0
    assert kernel.compile()


def _run(code: str, cache: Path, **settings: str) -> subprocess.CompletedProcess[str]:
    """Run Python in a process of its own, with a kernel cache at `cache`."""
    environment = {**os.environ, "VGTM_CACHE": str(cache), **settings}
    return subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=300
    )


LOADED = """
import casadi as ca
from vgtm_qp.compiled import Kernel
x = ca.SX.sym("x")
kernel = Kernel(ca.Function("square", [x], [x * x]))
kernel.inputs[0][:] = 3.0
kernel()
print(kernel.compile(), kernel.outputs[0][0])
"""


@needs_compiler
def test_a_damaged_library_is_made_again_and_never_loaded(tmp_path):
    assert _run(LOADED, tmp_path).stdout == "True 9.0\n"
    (library,) = tmp_path.glob("*.so")
    whole = library.read_bytes()
    for damage in (whole[:64] + bytes(len(whole) - 64), whole[: len(whole) // 2], whole[:-1] + b"x", b""):
        library.write_bytes(damage)
        found = _run(LOADED, tmp_path)
        assert (found.returncode, found.stdout) == (0, "True 9.0\n"), found.stderr
        assert library.read_bytes() == whole


@needs_compiler
def test_a_library_without_its_checksum_is_made_again(tmp_path, monkeypatch):
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path))
    assert Kernel(_square()).compile()
    (library,), (digest,) = tmp_path.glob("*.so"), tmp_path.glob("*.so.sha256")
    before = library.stat().st_ino
    assert Kernel(_square()).compile()
    assert library.stat().st_ino == before
    digest.unlink()
    assert Kernel(_square()).compile()
    assert library.stat().st_ino != before
    assert digest.exists()


@needs_compiler
@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owners")
@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777])
def test_a_cache_that_others_may_write_is_not_used(tmp_path, mode):
    cache = tmp_path / f"cache{mode:o}"
    cache.mkdir()
    cache.chmod(mode)
    found = _run(LOADED, cache)
    assert found.stdout == "False 9.0\n"
    assert f"chmod go-w {cache}" in found.stderr
    assert not list(cache.iterdir())


@needs_compiler
@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root gives files away")
def test_what_others_own_is_not_loaded(tmp_path, monkeypatch):
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path))
    assert Kernel(_square()).compile()
    (library,) = tmp_path.glob("*.so")
    before = library.stat().st_ino
    os.chown(library, 12345, 12345)
    assert Kernel(_square()).compile()
    assert library.stat().st_ino != before
    assert library.stat().st_uid == 0
    os.chown(tmp_path, 12345, 12345)
    found = _run(LOADED, tmp_path)
    assert found.stdout == "False 9.0\n"
    assert "belongs to another user" in found.stderr


@needs_compiler
def test_files_of_the_cache_that_others_may_write_are_made_again(tmp_path, monkeypatch):
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path / "cache"))
    mask = os.umask(0o000)
    try:
        assert Kernel(_long("open", 1.0)).compile()
    finally:
        os.umask(mask)
    for path in (tmp_path / "cache", *(tmp_path / "cache").iterdir()):
        assert not path.stat().st_mode & 0o022, path
    (library,) = (tmp_path / "cache").glob("*.so")
    before = library.stat().st_ino
    library.chmod(0o666)
    assert Kernel(_long("open", 1.0)).compile()
    assert library.stat().st_ino != before


LATER = """
import casadi as ca, time
from vgtm_qp.compiled import Kernel
x = ca.SX.sym("x")
kernel = Kernel(ca.Function("square", [x], [x * x]))
time.sleep(300.0)
"""
LONG = "from vgtm_qp.cli import main; raise SystemExit(main(['solve', 'five_bay_free', '--steps', '5000']))"
"""A maneuver that is not over before its kernels are compiled."""


def _hanging(folder: Path) -> Path:
    """Return a compiler that hangs, with a child that writes its number into ``child``."""
    wrapper = folder / "hangs"
    wrapper.write_text(
        f'#!/bin/sh\nsleep 600 &\necho $! > "{folder / "new"}"\nmv "{folder / "new"}" "{folder / "child"}"\nwait\n'
    )
    wrapper.chmod(0o755)
    return wrapper


def _wait(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 300.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def _is_running(number: int) -> bool:
    try:
        return Path(f"/proc/{number}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc")
def test_a_compiler_that_hangs_is_ended_with_its_children_and_not_asked_again(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("vgtm_qp.compiled.PATIENCE", 1.0)
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("VGTM_CC", str(_hanging(tmp_path)))
    try:
        assert not Kernel(_square()).compile()
        assert "did not end within 1 s" in caplog.text
        _wait(lambda: not _is_running(int((tmp_path / "child").read_text())))
        (tmp_path / "child").unlink()
        assert not Kernel(_long("after", 2.0)).compile()
        assert not (tmp_path / "child").exists()
    finally:
        stop_compilers()


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc")
@pytest.mark.parametrize("command", [LOADED, LONG])
def test_an_interrupt_ends_a_compiler_that_hangs_with_its_children(tmp_path, command):
    environment = {**os.environ, "VGTM_CACHE": str(tmp_path / "cache"), "VGTM_CC": str(_hanging(tmp_path))}
    with subprocess.Popen(
        [sys.executable, "-c", command], env=environment, cwd=tmp_path, stderr=subprocess.PIPE
    ) as process:
        _wait((tmp_path / "child").exists)
        child = int((tmp_path / "child").read_text())
        process.send_signal(signal.SIGINT)
        # The compiler would hang for ten minutes.
        process.communicate(timeout=300.0)
    assert process.returncode in (130, -signal.SIGINT)
    _wait(lambda: not _is_running(child))


def _waits(folder: Path) -> Path:
    """Return a compiler that notes in ``runs`` who runs it, and compiles only once there is a file ``go``."""
    wrapper = folder / "waits"
    wrapper.write_text(
        f'#!/bin/sh\necho $PPID >> "{folder / "runs"}"\n'
        f'while [ ! -e "{folder / "go"}" ]; do sleep 0.05; done\nexec {compiler()} "$@"\n'
    )
    wrapper.chmod(0o755)
    return wrapper


@needs_compiler
def test_no_call_waits_and_a_kernel_changes_over_when_its_library_is_there(tmp_path, monkeypatch, rng):
    cache = tmp_path / "cache"
    monkeypatch.setenv("VGTM_CACHE", str(cache))
    monkeypatch.setenv("VGTM_CC", str(_waits(tmp_path)))
    kernel = Kernel(_long("changing", 1.5))
    source, result = np.zeros(120), np.zeros(120)
    kernel.bind_input(0, source)
    kernel.bind_output(0, result)
    values = rng.normal(size=(20, 120))
    before = []
    for row in values:
        source[:] = row
        kernel()
        before.append(result.copy())
    _wait((tmp_path / "runs").exists)
    kernel()
    # The compiler runs until it may go on: no call can have waited for it.
    assert not kernel.is_compiled
    (tmp_path / "go").touch()
    _wait(lambda: bool(list(cache.glob("changing-*.so"))))
    for row, wanted in zip(values, before, strict=True):
        source[:] = row
        kernel()
        np.testing.assert_allclose(result, wanted, rtol=1e-14, atol=1e-14)
    assert kernel.is_compiled
    assert kernel.outputs[0] is result


@needs_compiler
def test_what_is_seldom_called_is_not_compiled(tmp_path, monkeypatch):
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("VGTM_CC", str(_waits(tmp_path)))
    kernel = Kernel(_square())
    for _ in range(7):
        assert _value(kernel) == 9.0
    assert not (tmp_path / "cache").exists()
    assert _value(kernel) == 9.0
    _wait((tmp_path / "runs").exists)
    stop_compilers()
    assert _value(kernel) == 9.0


OFTEN = """
import casadi as ca
from vgtm_qp.compiled import Kernel
x = ca.SX.sym("x")
kernel = Kernel(ca.Function("square", [x], [x * x]))
for _ in range(20):
    kernel()
import pathlib, time
while not pathlib.Path({runs!r}).exists():
    time.sleep(0.01)
print(kernel.is_compiled)
"""


@needs_compiler
def test_the_end_of_a_process_does_not_wait_and_its_kernels_are_compiled_for_the_next(tmp_path):
    cache, settings = tmp_path / "cache", {"VGTM_CC": str(_waits(tmp_path))}
    found = _run(OFTEN.format(runs=str(tmp_path / "runs")), cache, **settings)
    # The compiler still runs, and is not gone.
    assert (found.returncode, found.stdout) == (0, "False\n"), found.stderr
    assert not list(cache.glob("*.so"))
    (tmp_path / "go").touch()
    _wait(lambda: bool(list(cache.glob("*.so"))) and not list(cache.glob("*.new")))
    count = len((tmp_path / "runs").read_text().split())
    assert _run(LOADED, cache, **settings).stdout == "True 9.0\n"
    assert len((tmp_path / "runs").read_text().split()) == count


@needs_compiler
def test_two_processes_make_one_library_once(tmp_path):
    environment = {**os.environ, "VGTM_CACHE": str(tmp_path / "cache"), "VGTM_CC": str(_waits(tmp_path))}
    both = [
        subprocess.Popen([sys.executable, "-c", LOADED], env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    _wait((tmp_path / "runs").exists)
    (tmp_path / "go").touch()
    assert [process.communicate(timeout=300.0)[0] for process in both] == ["True 9.0\n"] * 2
    # One run for the object, one for the library.
    assert len((tmp_path / "runs").read_text().split()) == 2


@needs_compiler
def test_what_a_killed_process_left_in_the_cache_is_taken_over(tmp_path, monkeypatch):
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path))
    assert Kernel(_square()).compile()
    _wait(lambda: not list(tmp_path.glob("*.new")))
    (library,) = tmp_path.glob("*.so")
    library.unlink()
    for name in (f"{library.name}.new", f"{library.with_suffix('.o').name}.new"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "made").write_bytes(b"half")
        os.utime(tmp_path / name, (0.0, 0.0))
    assert Kernel(_square()).compile()
    _wait(lambda: not list(tmp_path.glob("*.new")))


@needs_compiler
def test_a_builder_that_is_killed_leaves_interpreted_kernels(tmp_path, monkeypatch):
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("VGTM_CC", str(_waits(tmp_path)))
    stop_compilers()
    kernel = Kernel(_square())
    for _ in range(10):
        kernel()
    _wait(lambda: (tmp_path / "runs").exists() and (tmp_path / "runs").read_text().endswith("\n"))
    os.kill(int((tmp_path / "runs").read_text()), signal.SIGKILL)
    _wait(lambda: _value(kernel) == 9.0 and kernel.is_done)
    assert _value(kernel) == 9.0
    assert not kernel.is_compiled
    (tmp_path / "go").touch()


@needs_compiler
def test_a_step_is_the_same_while_kernels_are_interpreted_and_once_they_are_compiled(tmp_path, monkeypatch):
    """The same maneuver with kernels that change over on the way, and with none that can."""
    problem = vq.Problem(
        truss={"module": "octahedral", "bays": 3},
        curve={"control_vertices": 4},
        maneuver={"steps": 24, "waypoint": [{"time": 6.0, "position": [0.4, 0.1, 2.2]}]},
        obstacle=[{"name": "ball", "shape": "sphere", "center": [0.9, 0.0, 1.4], "radius": 0.3}],
        clearance={"safe": 0.05},
    )
    monkeypatch.setenv("VGTM_CC", "none")
    interpreted = vq.Resolver(problem)
    monkeypatch.delenv("VGTM_CC")
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path))
    changing = vq.Resolver(problem)
    plan = make_plan(problem, *changing.tip())
    value, ready = plan.path.start, []
    for count, mark in enumerate(plan.marks.tolist()):
        if count == 12:
            finish_compiling()
        changing.state = interpreted.state
        steps = [one.follow(plan.path, value, mark) for one in (interpreted, changing)]
        assert all(step.moved for step in steps)
        np.testing.assert_allclose(steps[1].state.nodes, steps[0].state.nodes, rtol=0.0, atol=1e-10)
        value += steps[0].progress * (mark - value)
        ready.append(changing.setup.engine.is_ready)
    # It changed over on the way.
    assert not ready[0]
    assert ready[-1]
