"""Result files that claim or hold far more than a maneuver: refused from their headers, before they are inflated."""

from __future__ import annotations

import io
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import good_maneuver

from vgtm_qp.errors import ResultError
from vgtm_qp.maneuver.maneuver import load_result
from vgtm_qp.result import file as result_file

ROOT = Path(result_file.__file__).parents[2]


def header(shape: tuple[int, ...], descr: str = "<f8") -> bytes:
    stream = io.BytesIO()
    content: dict[str, Any] = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, content)
    return stream.getvalue()


def entries() -> dict[str, bytes]:
    """The entries of a good result file."""
    stream = io.BytesIO()
    maneuver = good_maneuver()
    found = {}
    for name, array in {**maneuver.arrays, "manifest": np.array("{}")}.items():
        stream = io.BytesIO()
        np.save(stream, array)
        found[f"{name}.npy"] = stream.getvalue()
    return found


def pack(path: Path, content: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    return path


CLAIMS: dict[str, tuple[Callable[[], dict[str, bytes]], str]] = {
    "21 PiB": (lambda: {"nodes.npy": header((1 << 40, 1000, 3))}, "array nodes is of float64 and shape"),
    "no bytes": (lambda: {"body_names.npy": header((1 << 50,), "<U0")}, "array body_names"),
    "more axes": (lambda: {"time.npy": header((1,) * 30)}, "array time"),
    "negative": (lambda: {"time.npy": header((-5,))}, "array time"),
    "objects": (lambda: {"time.npy": header((11,), "|O") + bytes(88)}, "array time"),
    "other kind": (lambda: {"time.npy": header((11,), "<c16") + bytes(176)}, "array time holds complex128"),
    "wide": (lambda: {"time.npy": header((11,), "<f16") + bytes(176)}, "array time holds"),
    "other axes": (lambda: {"nodes.npy": header((11, 5, 4)) + bytes(1760)}, r"nodes has shape \(11, 5, 4\)"),
    "other states": (lambda: {"nodes.npy": header((12, 5, 3)) + bytes(1440)}, r"expected \(T = 11, N, 3\)"),
    "unknown": (lambda: {"stray.npy": header((1,)) + bytes(8)}, "array stray is not one"),
    "no array": (lambda: {"time.npy": b"hello"}, "array time cannot be read"),
    "cut array": (lambda: {"time.npy": header((11,)) + bytes(80)}, "88 bytes; the file holds 80"),
    "folder": (lambda: {"../time.npy": header((11,)) + bytes(88)}, "is not one of a result file"),
    "manifest": (lambda: {"manifest.npy": header((3,), "<U2") + bytes(24)}, "manifest is not one string"),
}


@pytest.mark.parametrize("name", CLAIMS)
def test_a_claim_is_refused_from_its_header(name: str, tmp_path: Path, monkeypatch: Any) -> None:
    make, message = CLAIMS[name]
    path = pack(tmp_path / "claim.npz", {**entries(), **make()})
    monkeypatch.setattr(np, "load", lambda *_, **__: pytest.fail("an array was inflated"))
    monkeypatch.setattr(zipfile.ZipFile, "testzip", lambda _: pytest.fail("an array was inflated"))
    with pytest.raises(ResultError, match=message):
        load_result(path)


def test_an_array_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    path = pack(tmp_path / "twice.npz", entries())
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(path, "a") as archive:
        archive.writestr("time.npy", entries()["time.npy"])
    with pytest.raises(ResultError, match="time is there twice"):
        load_result(path)


def test_a_small_file_of_gigabytes_takes_no_memory(tmp_path: Path) -> None:
    """Three gigabytes of zeros in a file of 3 MB, with headers that are true, under a limit of address space."""
    path, states = tmp_path / "zeros.npz", 1 << 20
    content = entries()
    shapes = {"nodes.npy": (states, 128, 3)}
    for name, layout in result_file.LAYOUTS.items():
        if f"{name}.npy" in content and layout.axes[0] == "T" and name != "nodes":
            other = np.lib.format.read_array(io.BytesIO(content[f"{name}.npy"])).shape[1:]
            shapes[f"{name}.npy"] = (states, *other)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in content:
            with archive.open(name, "w", force_zip64=True) as stream:
                if name not in shapes:
                    stream.write(content[name])
                    continue
                stream.write(header(shapes[name]))
                left = 8 * int(np.prod(shapes[name]))
                while left:
                    stream.write(bytes(min(left, 1 << 24)))
                    left -= min(left, 1 << 24)
    assert path.stat().st_size < 20_000_000
    code = """
        import resource, sys
        from vgtm_qp.maneuver.maneuver import load_result
        from vgtm_qp.errors import ResultError
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        try:
            load_result(sys.argv[1])
        except ResultError as error:
            print(error)
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    """
    lines = "\n".join(line[8:] for line in code.splitlines())
    out = subprocess.run(
        [sys.executable, "-c", lines, str(path)], capture_output=True, text=True, check=True, cwd=ROOT
    )
    message, kilobytes = out.stdout.splitlines()
    assert "bytes of arrays; expected at most" in message
    assert int(kilobytes) < 100_000


def test_results_of_many_equal_states_are_still_read(tmp_path: Path) -> None:
    from synthetic import maneuver_of, swing, tripod

    nodes, _ = swing()
    count = 4000
    still = maneuver_of(np.tile(nodes[:1], (count, 1, 1)), np.arange(float(count)), tripod())
    assert load_result(still.save(tmp_path / "still.npz")).steps == count - 1
