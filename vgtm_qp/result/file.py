"""The result file: an ``.npz`` of named arrays without pickle, written atomically, checked when read."""

from __future__ import annotations

import hashlib
import math
import os
import re
import secrets
import time
import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import ExportError, ResultError
from vgtm_qp.result.manifest import check_manifest, dump_manifest, parse_manifest, stored_problem
from vgtm_qp.result.record import GREATEST

_STALE_SECONDS = 60.0
_WIDEST = 8
"""Greatest size of a number, bytes."""
_GREATEST_MANIFEST = 1 << 28
"""Greatest size of a manifest, bytes, at four a letter."""
_FREE_BYTES, _GREATEST_RATIO, _GREATEST_BYTES = 1 << 26, 100, 1 << 32
"""Inflated bytes allowed to any file; further ones per byte of the file; and the limit for all files."""
_UNREADABLE = (
    OSError,
    EOFError,
    NotImplementedError,
    RuntimeError,
    ValueError,
    zipfile.BadZipFile,
    zlib.error,
)
"""Errors that zipfile and numpy raise for a file that is cut, damaged, encrypted or of another kind."""


class ArrayLayout(NamedTuple):
    """Axes by name or size, kinds of number and finiteness of an array of the result file."""

    axes: tuple[str | int, ...]
    kinds: str = "f"
    finite: bool = True
    required: bool = True


LAYOUTS = {
    "time": ArrayLayout(("T",)),
    "nodes": ArrayLayout(("T", "N", 3)),
    "members": ArrayLayout(("M", 2), "iu"),
    "member_names": ArrayLayout(("M",), "U"),
    "member_actuated": ArrayLayout(("M",), "b"),
    "member_lengths": ArrayLayout(("T", "M")),
    "joints": ArrayLayout(("T", "J")),
    "joint_names": ArrayLayout(("J",), "U"),
    "body_names": ArrayLayout(("B",), "U"),
    "control_vertices": ArrayLayout(("T", "V", 3)),
    "tip_position": ArrayLayout(("T", 3)),
    "tip_rotation": ArrayLayout(("T", 3, 3)),
    "tip_target_position": ArrayLayout(("T", 3)),
    "clearance": ArrayLayout(("T",), finite=False),
    "self_clearance": ArrayLayout(("T",), finite=False),
    "progress": ArrayLayout(("T",)),
    "step_time": ArrayLayout(("T",)),
    "phase_names": ArrayLayout(("P",), "U"),
    "phase_time": ArrayLayout(("T", "P")),
    "tip_target_rotation": ArrayLayout(("T", 3, 3), required=False),
    "tip_target_pointing": ArrayLayout(("T", 3), required=False),
}

OF_TRUSSES = ("nodes", "members", "member_names", "member_actuated", "member_lengths")
OF_SERIAL_ARMS = ("joints", "joint_names", "body_names")


def names_of(arrays: Collection[str]) -> list[str]:
    """Return the names that arrays of a result file may have: a truss's, or a serial arm's, like `arrays`."""
    others = OF_TRUSSES if "joints" in arrays else OF_SERIAL_ARMS
    return [name for name in LAYOUTS if name not in others]


def write_result(path: Path, arrays: Mapping[str, NDArray[Any]], manifest: Mapping[str, Any]) -> None:
    """Write a result file; a process killed meanwhile leaves the old file or the new one."""
    unsigned = {key: value for key, value in manifest.items() if key != "digest"}
    text = dump_manifest({**unsigned, "digest": content_digest(arrays, unsigned)})
    content: dict[str, Any] = {**arrays, "manifest": np.array(text)}
    with replacing(path) as scratch, scratch.open("xb") as file:
        np.savez_compressed(file, **content)
        file.flush()
        os.fsync(file.fileno())
    _remove_stale_scratch(path)


@contextmanager
def replacing(path: Path, error: type[ResultError | ExportError] = ResultError) -> Iterator[Path]:
    """Yield a scratch file beside `path`, and move it there when it is complete, or raise `error`."""
    scratch = path.with_name(f".{path.name}.{secrets.token_hex(8)}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield scratch
            scratch.replace(path)
            _sync_directory(path.parent)
        finally:
            scratch.unlink(missing_ok=True)
    except OSError as reason:
        raise error(f"{path}: cannot be written: {reason.strerror or reason}") from None


class _Header(NamedTuple):
    """Shape and kind of an array in a result file, from its first bytes."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]


def read_result(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the arrays and the manifest of a result file, read without pickle and checked; see `Result.load`."""
    try:
        with zipfile.ZipFile(path) as archive:
            _check_headers(path, archive)
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
    try:
        manifest = check_manifest(parse_manifest(arrays.pop("manifest")))
        check_arrays(arrays)
        digest = content_digest(arrays, {key: value for key, value in manifest.items() if key != "digest"})
        if manifest.get("digest") != digest:
            raise ResultError("the content does not match its digest: an array or the manifest was altered")
        stored_problem(manifest["problem"])
    except ResultError as error:
        raise ResultError(f"{path}: {error}") from None
    return arrays, manifest


def plain(array: Any) -> NDArray[Any]:
    """Return an array in the byte order and width of the file."""
    array = np.asarray(array)
    wide = {"f": np.float64, "i": np.int64, "u": np.int64}.get(array.dtype.kind)
    return np.asarray(array, dtype=wide, order="C")


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """Return a copy on immutable bytes, which cannot be made writable again."""
    return np.ndarray(array.shape, array.dtype, buffer=array.tobytes())


def check_arrays(arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raise ResultError for the first array that is missing, unknown, malformed or has a wrong value."""
    sizes = _check_layout({name: _Header(array.shape, array.dtype) for name, array in arrays.items()})
    for name, array in arrays.items():
        unbounded = not LAYOUTS[name].finite
        if array.dtype.kind == "f" and (np.isnan(array).any() or (not unbounded and np.isinf(array).any())):
            row = int(np.argwhere(~np.isfinite(array))[0][0])
            raise ResultError(f"array {name} holds a value that is not a number, row {row}")
        if array.dtype.kind == "f" and (beyond := np.isfinite(array) & (np.abs(array) > GREATEST)).any():
            row = int(np.argwhere(beyond)[0][0])
            raise ResultError(f"array {name} holds a number beyond {GREATEST:g}, row {row}")
    members = arrays.get("members", np.zeros(0))
    if members.size and (members.min() < 0 or members.max() >= sizes["N"]):
        raise ResultError(f"array members names a node outside 0..{sizes['N'] - 1}")
    if (np.diff(arrays["time"]) <= 0.0).any():
        row = int(np.argmax(np.diff(arrays["time"]) <= 0.0)) + 1
        raise ResultError(f"array time does not increase at row {row}")


def _check_layout(headers: Mapping[str, _Header]) -> dict[str, int]:
    """Return the sizes of the axes by name; ResultError for a missing, unknown or malformed array."""
    possible = names_of(headers)
    for name in headers:
        if name not in possible:
            raise ResultError(f"array {name} is not one of a result file; those are {', '.join(possible)}")
    sizes: dict[str, int] = {}
    for name in possible:
        layout = LAYOUTS[name]
        if name not in headers:
            if layout.required:
                raise ResultError(f"array {name} is missing")
            continue
        shape, dtype = headers[name]
        if dtype.kind not in layout.kinds or (dtype.kind != "U" and dtype.itemsize > _WIDEST):
            raise ResultError(f"array {name} holds {dtype}; expected kind {' or '.join(layout.kinds)}")
        expected = tuple(sizes.get(a, a) if isinstance(a, str) else a for a in layout.axes)
        if len(shape) != len(expected) or any(
            isinstance(e, int) and e != size for e, size in zip(expected, shape, strict=True)
        ):
            axes = ", ".join(f"{a} = {sizes[a]}" if a in sizes else str(a) for a in layout.axes)
            raise ResultError(f"array {name} has shape {shape}; expected ({axes})")
        sizes |= {a: size for a, size in zip(layout.axes, shape, strict=True) if isinstance(a, str)}
    states = "joints" if "joints" in headers else "nodes"
    if min(headers[states].shape[:2]) < 1:
        raise ResultError(f"there is no state in it: array {states} is empty")
    return sizes


def _check_headers(path: Path, archive: zipfile.ZipFile) -> None:
    """Raise ResultError if an archive is not a result file; only the headers of its arrays are decompressed.

    A result file has arrays of known names, kinds and shapes. Each has the number of bytes that its header
    claims. All together are not larger than a maneuver in a file of that size can be.
    """
    if "manifest.npy" not in archive.namelist():
        raise ResultError(f"{path}: has no manifest, so it is not a result file")
    headers: dict[str, _Header] = {}
    total = 0
    for entry in archive.infolist():
        name = entry.filename.removesuffix(".npy")
        if name in headers or not entry.filename.endswith(".npy") or name not in (*LAYOUTS, "manifest"):
            possible = ", ".join((*names_of(headers), "manifest"))
            found = "is there twice" if name in headers else "is not one of a result file"
            raise ResultError(f"{path}: array {name[:60]} {found}; those are {possible}")
        with archive.open(entry) as stream:
            headers[name] = _header(f"{path}: array {name}", stream, entry.file_size)
        total += entry.file_size
    manifest = headers.pop("manifest")
    if manifest.shape or manifest.dtype.kind != "U" or manifest.dtype.itemsize > _GREATEST_MANIFEST:
        raise ResultError(
            f"{path}: the manifest is not one string of at most {_GREATEST_MANIFEST // 4} letters"
        )
    try:
        _check_layout(headers)
    except ResultError as error:
        raise ResultError(f"{path}: {error}") from None
    greatest = min(_GREATEST_BYTES, _FREE_BYTES + _GREATEST_RATIO * path.stat().st_size)
    if total > greatest:
        raise ResultError(
            f"{path}: holds {total} bytes of arrays; expected at most {greatest} in a file of its size"
        )


def _header(about: str, stream: IO[bytes], size: int) -> _Header:
    """Return the header at the start of an entry of `size` bytes; ResultError if it claims another size."""
    try:
        version = np.lib.format.read_magic(stream)
        read = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = read(stream)
        begin = stream.tell()
    except (ValueError, TypeError, SyntaxError, TokenError, RecursionError, MemoryError) as error:
        raise ResultError(f"{about} cannot be read: {str(error)[:200]}") from None
    bytes_claimed = math.prod(shape) * dtype.itemsize
    # Items without bytes could be any number.
    if min(shape, default=0) < 0 or dtype.hasobject or not dtype.itemsize or begin + bytes_claimed != size:
        raise ResultError(
            f"{about} is of {dtype} and shape {shape}, {bytes_claimed} bytes; the file holds {size - begin} of it"
        )
    return _Header(shape, dtype)


def content_digest(arrays: Mapping[str, NDArray[Any]], manifest: Mapping[str, Any]) -> str:
    """Return the SHA-256 of names, kinds, shapes and values of `arrays` and of `manifest` less its digest."""
    digest = hashlib.sha256(dump_manifest(manifest).encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"\0{name}\0{array.dtype.str}\0{array.shape}\0".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _read_array(path: Path, file: Any, name: str) -> NDArray[Any]:
    try:
        array = file[name]
    except ValueError as error:
        raise ResultError(f"{path}: array {name} cannot be read: {error}") from None
    if not isinstance(array, np.ndarray):
        raise ResultError(f"{path}: {name} is not an array")
    return array


def _remove_stale_scratch(path: Path) -> None:
    """Remove scratch files that killed saves of `path` left behind; a young one may belong to a save under way."""
    scratch = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]{{16}}\.tmp")
    # The file is saved already: it is no failure if a scratch file cannot be removed, or another save removes
    # it.
    with suppress(OSError):
        for entry in path.parent.iterdir():
            if scratch.fullmatch(entry.name) and time.time() - entry.stat().st_mtime > _STALE_SECONDS:
                entry.unlink()


def _sync_directory(directory: Path) -> None:
    """Make the new name survive a power cut, if the system lets a directory be opened."""
    try:
        handle = os.open(directory, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
