"""A document as tables that can be read on a terminal and pasted into Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from vgtm_qp.comparison.tables import markdown_table

_PHASES = ("distance", "qp", "correction", "acceptance", "other")


def render(document: dict[str, Any]) -> str:
    """Return the tables of a document as text."""
    return "\n\n".join(_parts(document))


def _parts(document: dict[str, Any]) -> Iterator[str]:
    machine, start, settings = document["machine"], document["start"], document["settings"]
    load = machine["load"][0]
    threads = "one BLAS thread" if settings["one_blas_thread"] else "BLAS THREADS NOT PINNED"
    versions = ", ".join(f"{name} {version}" for name, version in document["versions"].items() if version)
    at = f"Commit {document['commit'][:12]}, " if document["commit"] else ""
    yield (
        f"{at}{machine['processor']}, {machine['cores']} cores, load {load}, Python {machine['python']}, {threads}\n"
        f"{versions}\n"
        f"CPU to start: python {start['python']:.3f} s, import vgtm_qp {start['import']:.3f} s, "
        f"vgtm --help {start['help']:.3f} s"
    )
    yield _steps(document["scenes"])
    if document["baselines"]:
        yield _baselines(document)
        yield "\n".join(f"{name}: {title}" for name, title in document["baselines"].items())
    if document["growth"]:
        yield _growth(document["growth"])
    if "compared" in document:
        yield _compared(document["compared"])


def _steps(scenes: Sequence[dict[str, Any]]) -> str:
    known = [name for scene in scenes for name in scene["breakdown"]["phases"]]
    phases = sorted(dict.fromkeys(known), key=lambda name: _PHASES.index(name) if name in _PHASES else -1)
    timed = ("median", "p95", "p99", "CPU", *phases)
    heads = ("steps", "QPs", "FCL + exact rows", *timed, "set-up", "cold", "memory", "covered")
    rows = []
    for scene in scenes:
        step, cold = scene["step"], scene["cold"]
        rows.append(
            (
                scene["name"],
                str(step["steps"]),
                f"{scene['qps']:.2f}",
                f"{scene.get('fcl_rows', 0.0):.1f} + {scene.get('exact_rows', 0.0):.1f}",
                *(_time(step[key]) for key in ("median", "p95", "p99", "cpu")),
                *(_time(scene["breakdown"]["phases"].get(name)) for name in phases),
                _setup(scene["warm"]),
                _setup(cold),
                f"{scene['warm']['peak_memory'] / 1e6:.0f} MB",
                f"{100 * scene['covered']:.0f} %"
                + (f", {scene['stopped_by']}" if scene["stopped_by"] else ""),
            )
        )
    return markdown_table(("one step", *heads), rows, right=True)


def _baselines(document: dict[str, Any]) -> str:
    names = list(document["baselines"])
    rows = []
    for scene in document["scenes"]:
        cells = [_against(scene["baselines"][name]) for name in names]
        rows.append((scene["name"], _time(scene["step"]["cpu"]), *cells))
    return markdown_table(("CPU, and ratio to ours in turn", "ours", *names), rows, right=True)


def _setup(fresh: dict[str, Any] | None) -> str:
    return f"{_time(fresh['setup'])} (CPU {_time(fresh['setup_cpu'])})" if fresh else "-"


def _against(found: dict[str, Any]) -> str:
    if not found["step"]:
        return "-"
    failed = f", {found['failed']} failed" if found["failed"] else ""
    return f"{_time(found['step']['cpu'])}, x {found['ratio']:.3g}{failed}"


def _growth(rows: Iterable[dict[str, Any]]) -> str:
    cells = [
        (row["method"], row["tracking"], ", ".join(map(str, row["bays"])), f"{row['exponent']:.2f}")
        for row in rows
    ]
    return markdown_table(("method", "tracking", "bays", "growth exponent"), cells, right=True)


def _compared(found: dict[str, Any]) -> str:
    rows = [
        (
            row["name"],
            _time(row["old"]),
            _time(row["new"]),
            f"{row['cpu']:.2f}",
            f"{row['corrected']:.2f} by {row['by']}" if row["by"] else "-",
            *(f"{row[key]:.2f}" for key in ("p99", "setup", "memory")),
        )
        for row in found["scenes"]
    ]
    since = f"new / old, {(found['commit'] or found['time'])[:10]}"
    heads = (since, "old CPU", "new CPU", "ratio", "corrected", "p99", "set-up", "memory")
    return markdown_table(heads, rows, right=True)


def _time(seconds: float | None) -> str:
    """Return a time with three digits and its unit."""
    if seconds is None:
        return "-"
    for factor, unit in ((1e6, "us"), (1e3, "ms")):
        if seconds * factor < 999.5:
            return f"{seconds * factor:.3g} {unit}"
    return f"{seconds:.3g} s"
