"""The result file: one ``.npz`` without pickle, written atomically and read with all of it checked."""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import time
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import ExportError, ResultError
from vgtm_qp.result.layout import check_arrays
from vgtm_qp.result.manifest import check_manifest, dump_manifest, parse_manifest

_STALE_SECONDS = 60.0
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


def write_result(path: Path, arrays: Mapping[str, NDArray[Any]], manifest: Mapping[str, Any]) -> None:
    """Write a result file; a process killed meanwhile leaves the old file or the new one.

    Raises
    ------
    ResultError
        The file cannot be written.
    """
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
    """Yield a scratch file beside `path` that takes its place once it is whole; raise `error` where that fails."""
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


def read_result(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the arrays and the manifest of a result file, read without pickle and checked.

    Raises
    ------
    ResultError
        There is no such file, it is cut or altered, of another version, or an array is missing or malformed.
    """
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
        check_arrays(arrays)
        digest = content_digest(arrays, {key: value for key, value in manifest.items() if key != "digest"})
        if manifest.get("digest") != digest:
            raise ResultError("the content does not match its digest: an array or the manifest was altered")
    except ResultError as error:
        raise ResultError(f"{path}: {error}") from None
    return arrays, manifest


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
    # The result is saved already: a scratch file that cannot be removed, or that another save removes, is no failure.
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
