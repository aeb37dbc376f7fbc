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
    load = f", load {machine['load'][0]}" if machine["load"] else ""
    threads = "one BLAS thread" if settings["one_blas_thread"] else "BLAS THREADS NOT PINNED"
    versions = ", ".join(f"{name} {version}" for name, version in document["versions"].items() if version)
    at = f"Commit {document['commit'][:12]}, " if document["commit"] else ""
    yield (
        f"{at}{machine['processor']}, {machine['cores']} cores{load}, Python {machine['python']}, {threads}\n"
        f"{versions}\n"
        f"CPU to start: python {start['python']:.3f} s, import vgtm_qp {start['import']:.3f} s, "
        f"vgtm --help {start['help']:.3f} s"
    )
    yield (
        "One step is Resolver.step(position=...) to the next mark of the maneuver, there and back, after one such tour."
    )
    yield _steps(document["scenes"])
    yield _phases(document["scenes"])
    if document["baselines"]:
        yield _baselines(document)
        yield "\n".join(_legend(document))
        yield from _between(document)
    yield _fresh(document["scenes"])
    if document["growth"]:
        yield _growth(document["growth"])
    if "compared" in document:
        yield _compared(document["compared"])


def phase_names(scenes: Iterable[dict[str, Any]]) -> list[str]:
    """Return the names of all phases of scenes in the order of a step, ``other`` last."""
    names = dict.fromkeys(name for scene in scenes for name in scene["breakdown"]["phases"])
    return sorted(names, key=lambda name: _PHASES.index(name) if name in _PHASES else -1)


def _steps(scenes: Iterable[dict[str, Any]]) -> str:
    shares = ("median", "95 %", "99 %", "100 %")
    heads = ("clock", "steps", *shares, *(f"CPU {share}" for share in shares), "CPU 99 % / median")
    keys = ("median", "p95", "p99", "max", "cpu", "cpu_p95", "cpu_p99", "cpu_max")
    rows = []
    for scene in scenes:
        step = scene["step"]
        times = (time_text(step[key]) for key in keys)
        rows.append((scene["name"], str(step["steps"]), *times, f"{step['cpu_p99'] / step['cpu']:.1f}"))
    return markdown_table(heads, rows, right=True)


def _phases(scenes: Sequence[dict[str, Any]]) -> str:
    names = phase_names(scenes)
    rows = []
    for scene in scenes:
        found, stopped = scene["breakdown"], scene["stopped_by"]
        parts = (found["phases"].get(name) for name in names)
        counts = (
            f"{scene[key]:.{digits}f}" for key, digits in (("qps", 2), ("fcl_rows", 1), ("exact_rows", 1))
        )
        covered = f"{100 * scene['covered']:.0f} %" + (f", {_few(stopped)}" if stopped else "")
        rows.append((scene["name"], time_text(found["total"]), *map(time_text, parts), *counts, covered))
    heads = ("mean by phase", "total", *names, "QPs", "rows by FCL", "exact rows", "covered")
    return markdown_table(heads, rows, right=True)


def _few(names: str) -> str:
    """Return names that are separated by commas, the first two of them if there are many."""
    first = names.split(", ")
    return names if len(first) < 4 else f"{first[0]}, {first[1]} and {len(first) - 2} more"


def _baselines(document: dict[str, Any]) -> str:
    scenes = document["scenes"]
    names = [
        name for name in document["baselines"] if any(scene["baselines"][name]["step"] for scene in scenes)
    ]
    rows = []
    for scene in scenes:
        cells = [_against(scene["baselines"][name]) for name in names]
        rows.append((scene["name"], time_text(scene["step"]["cpu"]), *cells))
    return markdown_table(("CPU, and ratio to ours in turn", "ours", *names), rows, right=True)


def _between(document: dict[str, Any]) -> Iterator[str]:
    """Yield the least clearances at and between steps, if some baseline goes the whole way by itself."""
    scenes = [scene for scene in document["scenes"] if scene.get("between") is not None]
    every = (name for scene in scenes for name, found in scene["baselines"].items() if found.get("between"))
    names = list(dict.fromkeys(every))
    rows = []
    for scene in scenes:
        least = [scene["safe"], scene["between"], *(scene["baselines"][name]["between"] for name in names)]
        rows.append((scene["name"], *("-" if value is None else f"{1e3 * value:.3f} mm" for value in least)))
    if rows:
        yield markdown_table(
            ("least clearance, at and between steps", "asked for", "ours", *names), rows, right=True
        )


def _legend(document: dict[str, Any]) -> Iterator[str]:
    """Yield what each baseline is, and why a baseline has no column."""
    for name, title in document["baselines"].items():
        found = [scene["baselines"][name] for scene in document["scenes"]]
        missing = "" if any(entry["step"] for entry in found) else found[-1]["skipped"] if found else ""
        yield f"{name}: {title}" + (f" (not measured: {missing})" if missing else "")


def _against(found: dict[str, Any]) -> str:
    if not found["step"]:
        return "-"
    failed = f", {found['failed']} failed" if found["failed"] else ""
    return f"{time_text(found['step']['cpu'])}, x {found['ratio']:.3g}{failed}"


def _fresh(scenes: Iterable[dict[str, Any]]) -> str:
    rows = [
        (
            scene["name"],
            f"{time_text(scene['warm']['setup'])} (CPU {time_text(scene['warm']['setup_cpu'])})",
            time_text(scene["warm"]["to_first_step"]),
            *(time_text((scene["cold"] or {}).get(key)) for key in ("to_first_step", "to_result")),
            f"{scene['warm']['peak_memory'] / 1e6:.0f} MB",
        )
        for scene in scenes
    ]
    heads = (
        "fresh process",
        "set-up",
        "to first step",
        "the same, no cache",
        "to result, no cache",
        "memory",
    )
    return markdown_table(heads, rows, right=True)


def _growth(rows: Iterable[dict[str, Any]]) -> str:
    cells = [
        (
            row["kind"],
            row["method"],
            row["tracking"],
            ", ".join(map(str, row["bays"])),
            f"{row['exponent']:.2f}",
        )
        for row in rows
    ]
    return markdown_table(
        ("scenes", "method", "tracking", "bays or joints", "growth exponent"), cells, right=True
    )


def _compared(found: dict[str, Any]) -> str:
    rows = [
        (
            row["name"],
            time_text(row["old"]),
            time_text(row["new"]),
            f"{row['cpu']:.2f}",
            f"{row['corrected']:.2f} by {row['by']}" if row["by"] else "-",
            *(f"{row[key]:.2f}" for key in ("p99", "setup", "memory")),
        )
        for row in found["scenes"]
    ]
    since = f"new / old, {(found['commit'] or found['time'])[:10]}"
    heads = (since, "old CPU", "new CPU", "ratio", "corrected", "p99", "set-up", "memory")
    return markdown_table(heads, rows, right=True)


def time_text(seconds: float | None) -> str:
    """Return a time with three digits and its unit."""
    if seconds is None:
        return "-"
    for factor, unit in ((1e6, "us"), (1e3, "ms")):
        if seconds * factor < 999.5:
            return f"{seconds * factor:.3g} {unit}"
    return f"{seconds:.3g} s"
