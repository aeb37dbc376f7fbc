"""A maneuver as data, and the result file that holds it: one ``.npz`` without pickle, written atomically."""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import time
import zipfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import ResultError
from vgtm_qp.maneuver.certificate import Certificate
from vgtm_qp.maneuver.manifest import check_manifest, dump_manifest, parse_manifest

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

_STALE_SECONDS = 60.0


class _Layout(NamedTuple):
    """What an array of the result file must be: axes by name or size, kinds of number, finiteness."""

    axes: tuple[str | int, ...]
    kinds: str = "f"
    finite: bool = True
    required: bool = True


_LAYOUTS = {
    "time": _Layout(("T",)),
    "nodes": _Layout(("T", "N", 3)),
    "members": _Layout(("M", 2), "iu"),
    "member_names": _Layout(("M",), "U"),
    "member_actuated": _Layout(("M",), "b"),
    "member_lengths": _Layout(("T", "M")),
    "control_vertices": _Layout(("T", "V", 3)),
    "tip_position": _Layout(("T", 3)),
    "tip_rotation": _Layout(("T", 3, 3)),
    "tip_target_position": _Layout(("T", 3)),
    "clearance": _Layout(("T",), finite=False),
    "self_clearance": _Layout(("T",), finite=False),
    "progress": _Layout(("T",)),
    "step_time": _Layout(("T",)),
    "phase_names": _Layout(("P",), "U"),
    "phase_time": _Layout(("T", "P")),
    "tip_target_rotation": _Layout(("T", 3, 3), required=False),
    "tip_target_pointing": _Layout(("T", 3), required=False),
}
_UNREADABLE = (
    OSError,
    EOFError,
    NotImplementedError,
    RuntimeError,
    ValueError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What zipfile and numpy raise over a file that is cut, damaged, encrypted or of another kind."""


@dataclass(frozen=True, eq=False, repr=False)
class Maneuver:
    """Every accepted state of a maneuver; row 0 is the home pose. The arrays are read-only.

    Attributes
    ----------
    time : (T,)
        Seconds, increasing.
    nodes : (T, N, 3)
        Node positions, m.
    members, member_names, member_actuated : (M, 2), (M,), (M,)
        The nodes, name and kind of each member.
    member_lengths : (T, M)
        m.
    control_vertices : (T, V, 3)
        Control vertices of the reference curve, m; V = 0 without a curve.
    tip_position, tip_rotation, tip_target_position : (T, 3), (T, 3, 3), (T, 3)
        Pose of the end effector and the target that each state was accepted for, m.
    clearance, self_clearance : (T,)
        Least distance to obstacles, and between members that share no node, m; inf where there are none.
    progress : (T,)
        How far along the path, 0 to 1.
    step_time, phase_names, phase_time : (T,), (P,), (T, P)
        Computing time of each step and of its phases, s; 0 in row 0.
    manifest : dict
        Plain data, see `make_manifest`.
    tip_target_rotation, tip_target_pointing : (T, 3, 3) or None, (T, 3) or None
        Targets of orientation or direction where they were tracked.

    Raises
    ------
    ResultError
        An array has another shape or kind than this, holds a NaN, or the manifest is not strict JSON.
    """

    time: Array
    nodes: Array
    members: NDArray[np.int64]
    member_names: NDArray[np.str_]
    member_actuated: NDArray[np.bool_]
    member_lengths: Array
    control_vertices: Array
    tip_position: Array
    tip_rotation: Array
    tip_target_position: Array
    clearance: Array
    self_clearance: Array
    progress: Array
    step_time: Array
    phase_names: NDArray[np.str_]
    phase_time: Array
    manifest: dict[str, Any]
    tip_target_rotation: Array | None = None
    tip_target_pointing: Array | None = None

    def __post_init__(self) -> None:
        """Check shapes and kinds; freeze copies of the arrays."""
        arrays = {name: _plain(getattr(self, name)) for name in _LAYOUTS if getattr(self, name) is not None}
        _check_arrays(arrays)
        for name, array in arrays.items():
            object.__setattr__(self, name, _frozen(array))
        object.__setattr__(self, "manifest", check_manifest(self.manifest))

    def __str__(self) -> str:
        """Return one paragraph: name, status, steps, what stopped it, what verification found."""
        text = f"{self._name}: {self.status}, {100.0 * self.reached:.4g} % of the path in {self.steps} steps."
        if way := self.manifest.get("way_out"):
            text += f" Not as asked at first, which was a dead end, but by a way out: {way}."
        if self.blocked_by:
            text += f" Stopped by {', '.join(self.blocked_by[:4])}."
        certificate = self.certificate
        if certificate is None:
            return f"{text} Not verified yet."
        if certificate.ok:
            return f"{text} Verified."
        return f"{text} VERIFICATION FAILED: {'; '.join(certificate.failures()[:4])}."

    def __repr__(self) -> str:
        return f"<Maneuver {self._name!r}: {self.status}, {self.steps} steps, {100.0 * self.reached:.4g} %>"

    @property
    def _name(self) -> str:
        return str(self.manifest["problem"].get("name", "unnamed"))

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of the result file by name, those that this maneuver has."""
        return {name: array for name in _LAYOUTS if (array := getattr(self, name)) is not None}

    @property
    def status(self) -> str:
        """``"solved"``, ``"blocked"`` or ``"infeasible"``."""
        return str(self.manifest["status"])

    @property
    def reached(self) -> float:
        """How far along the path the arm came, 0 to 1."""
        return float(self.manifest["reached"])

    @property
    def blocked_by(self) -> tuple[str, ...]:
        """Names of the obstacles, members and limits that stopped it."""
        return tuple(self.manifest["blocked_by"])

    @property
    def steps(self) -> int:
        """Number of accepted steps."""
        return len(self.time) - 1

    @property
    def certificate(self) -> Certificate | None:
        """What verification found; None before it."""
        data = self.manifest.get("certificate")
        return None if data is None else Certificate.from_dict(data)

    def with_certificate(self, certificate: Certificate) -> Maneuver:
        """Return this maneuver with `certificate` in its manifest."""
        return replace(self, manifest={**self.manifest, "certificate": certificate.to_dict()})

    def summary(self, result: str | Path | None = None) -> dict[str, Any]:
        """Return what ``vgtm solve --json`` prints, as strict JSON data; `result` is the path of the file.

        What only a certificate knows is None before there is one. A certificate measures no deeper than the members'
        radius into an obstacle; there the clearance between states is that at the states, which is never greater.
        """
        certificate = self.certificate
        manifest = self.manifest
        finite = self.clearance[np.isfinite(self.clearance)]
        least = float(finite.min()) if len(finite) else None

        def worst(name: str) -> float | None:
            return None if certificate is None else certificate.measures[name].value

        between = worst("clearance_between")
        if between is not None and least is not None:
            between = min(between, least)
        return {
            "name": manifest["problem"].get("name", ""),
            "status": self.status,
            "reached": self.reached,
            "steps": self.steps,
            "bays": manifest["arm"].get("bays"),
            "method": manifest.get("method"),
            "solver": manifest.get("solver"),
            "min_clearance": least,
            "min_clearance_between": between,
            "min_self_clearance": worst("self_clearance"),
            "max_member_error": worst("member_error"),
            "max_stroke_violation": worst("stroke_violation"),
            "max_rate_violation": worst("rate_violation"),
            "max_tip_error": worst("tip_error"),
            "max_tip_direction_error": worst("tip_direction_error"),
            "step_time": self._step_time(),
            "setup_time": manifest.get("setup_time"),
            "blocked_by": list(self.blocked_by),
            "way_out": str(self.manifest.get("way_out", "")),
            "verified": None if certificate is None else certificate.ok,
            "failures": [] if certificate is None else list(certificate.failures()),
            "result": None if result is None else str(result),
        }

    def _step_time(self) -> dict[str, Any]:
        """Median and percentiles of the steps, median of each phase, s; the home pose took no step."""
        times = self.step_time[1:]
        if not len(times):
            return {"median": None, "p95": None, "p99": None, "phases": {}}
        median, p95, p99 = (float(value) for value in np.percentile(times, (50, 95, 99)))
        phases = np.median(self.phase_time[1:], axis=0)
        named = {str(name): float(value) for name, value in zip(self.phase_names, phases, strict=True)}
        return {"median": median, "p95": p95, "p99": p99, "phases": named}

    def save(self, path: str | Path) -> Path:
        """Write the result file and return its path; a process killed meanwhile leaves the old or the new.

        Raises
        ------
        ResultError
            The file cannot be written.
        """
        path = Path(path)
        arrays = self.arrays
        manifest = {key: value for key, value in self.manifest.items() if key != "digest"}
        text = dump_manifest({**manifest, "digest": content_digest(arrays, manifest)})
        scratch = path.with_name(f".{path.name}.{secrets.token_hex(8)}.tmp")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                with scratch.open("xb") as file:
                    content: dict[str, Any] = {**arrays, "manifest": np.array(text)}
                    np.savez_compressed(file, **content)
                    file.flush()
                    os.fsync(file.fileno())
                scratch.replace(path)
            finally:
                scratch.unlink(missing_ok=True)
            _sync_directory(path.parent)
            _remove_stale_scratch(path)
        except OSError as error:
            raise ResultError(f"{path}: cannot be written: {error.strerror or error}") from None
        return path

    def plot(self, **options: Any) -> Figure:
        """Return a figure of states side by side; see `vgtm_qp.view.figure.plot_frames` for the options."""
        # Imported here, against the way of the data, since only who plots should pay for matplotlib.
        from vgtm_qp.view.figure import plot_frames

        return plot_frames(self, **options)

    def plot_clearance(self, *, axes: Axes | None = None) -> Figure:
        """Plot the least distances to obstacles and between members over time."""
        from vgtm_qp.view.plots import plot_clearance

        return plot_clearance(self, axes=axes)

    def plot_strokes(self, *, axes: Axes | None = None) -> Figure:
        """Plot the lengths of the actuated members over time, between their limits."""
        from vgtm_qp.view.plots import plot_strokes

        return plot_strokes(self, axes=axes)

    def plot_tip_error(self, *, axes: Axes | None = None) -> Figure:
        """Plot the distance of the tip from its target over time."""
        from vgtm_qp.view.plots import plot_tip_error

        return plot_tip_error(self, axes=axes)

    def plot_step_time(self, *, axes: Axes | None = None) -> Figure:
        """Plot the computing time of each step by phase."""
        from vgtm_qp.view.plots import plot_step_time

        return plot_step_time(self, axes=axes)

    @classmethod
    def load(cls, path: str | Path) -> Maneuver:
        """Read a result file; see `load_result`."""
        return load_result(path)


def load_result(path: str | Path) -> Maneuver:
    """Read a result file, without pickle, and check all of it.

    Raises
    ------
    ResultError
        There is no such file, it is cut or altered, of another version, or an array is missing or malformed.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            broken = archive.testzip()
            if broken is not None:
                raise ResultError(f"{path}: {broken} is damaged")
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: _read_array(path, file, name) for name in file.files}
    except FileNotFoundError:
        raise ResultError(f"{path}: there is no such file") from None
    except IsADirectoryError:
        raise ResultError(f"{path}: a folder; expected a result file, .npz") from None
    except PermissionError:
        raise ResultError(f"{path}: may not be read: permission denied") from None
    except _UNREADABLE:
        raise ResultError(f"{path}: not a whole result file: cut, damaged, or of another kind") from None
    if "manifest" not in arrays:
        raise ResultError(f"{path}: has no manifest, so it is not a result file")
    try:
        manifest = check_manifest(parse_manifest(arrays.pop("manifest")))
        _check_arrays(arrays)
        digest = content_digest(arrays, {key: value for key, value in manifest.items() if key != "digest"})
        if manifest.get("digest") != digest:
            raise ResultError("the content does not match its digest: an array or the manifest was altered")
        return Maneuver(**arrays, manifest=manifest)
    except ResultError as error:
        raise ResultError(f"{path}: {error}") from None


def content_digest(arrays: Mapping[str, NDArray[Any]], manifest: Mapping[str, Any]) -> str:
    """Return the SHA-256 of names, kinds, shapes and values of `arrays` and of `manifest` less its digest."""
    digest = hashlib.sha256(dump_manifest(manifest).encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"\0{name}\0{array.dtype.str}\0{array.shape}\0".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _plain(array: Any) -> NDArray[Any]:
    """Return an array in the one byte order and width that the file holds."""
    array = np.asarray(array)
    wide = {"f": np.float64, "i": np.int64, "u": np.int64}.get(array.dtype.kind)
    return np.asarray(array, dtype=wide, order="C")


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    """Return a copy on immutable bytes, which cannot be made writable again either."""
    return np.ndarray(array.shape, array.dtype, buffer=array.tobytes())


def _check_arrays(arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raise ResultError for the first array that is missing, unknown, malformed or holds no number."""
    for name in arrays:
        if name not in _LAYOUTS:
            raise ResultError(f"array {name} is not one of a result file; those are {', '.join(_LAYOUTS)}")
    sizes: dict[str, int] = {}
    for name, layout in _LAYOUTS.items():
        if name not in arrays:
            if layout.required:
                raise ResultError(f"array {name} is missing")
            continue
        array = arrays[name]
        if array.dtype.kind not in layout.kinds:
            raise ResultError(f"array {name} holds {array.dtype}; expected kind {' or '.join(layout.kinds)}")
        expected = tuple(sizes.get(a, a) if isinstance(a, str) else a for a in layout.axes)
        if array.ndim != len(expected) or any(
            isinstance(e, int) and e != size for e, size in zip(expected, array.shape, strict=True)
        ):
            axes = ", ".join(f"{a} = {sizes[a]}" if a in sizes else str(a) for a in layout.axes)
            raise ResultError(f"array {name} has shape {array.shape}; expected ({axes})")
        sizes |= {a: size for a, size in zip(layout.axes, array.shape, strict=True) if isinstance(a, str)}
        if array.dtype.kind == "f" and (np.isnan(array).any() or (layout.finite and np.isinf(array).any())):
            row = int(np.argwhere(~np.isfinite(array))[0][0])
            raise ResultError(f"array {name} holds a value that is not a number, row {row}")
    if sizes["T"] < 1 or sizes["N"] < 1:
        raise ResultError("there is no state in it: array nodes is empty")
    members = arrays["members"]
    if members.size and (members.min() < 0 or members.max() >= sizes["N"]):
        raise ResultError(f"array members names a node outside 0..{sizes['N'] - 1}")
    if (np.diff(arrays["time"]) <= 0.0).any():
        row = int(np.argmax(np.diff(arrays["time"]) <= 0.0)) + 1
        raise ResultError(f"array time does not increase at row {row}")


def _read_array(path: Path, file: Any, name: str) -> NDArray[Any]:
    try:
        array = file[name]
    except ValueError as error:
        raise ResultError(f"{path}: array {name} cannot be read: {error}") from None
    if not isinstance(array, np.ndarray):
        raise ResultError(f"{path}: {name} is not an array")
    return array


def _remove_stale_scratch(path: Path) -> None:
    """Remove what a save of `path` left behind that was killed; a young one may be that of a save under way."""
    scratch = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]{{16}}\.tmp")
    # The result is saved by now, so what cannot be removed, or another save removes first, is no failure.
    with suppress(OSError):
        for entry in path.parent.iterdir():
            if scratch.fullmatch(entry.name) and time.time() - entry.stat().st_mtime > _STALE_SECONDS:
                entry.unlink()


def _sync_directory(directory: Path) -> None:
    """Make the new name itself survive a power cut, where the system lets a directory be opened."""
    try:
        handle = os.open(directory, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
