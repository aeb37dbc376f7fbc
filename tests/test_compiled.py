"""Compiled kernels and their cache."""

from __future__ import annotations

import casadi as ca
import pytest

from vgtm_qp.compiled import Kernel, compiler

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
    assert Kernel(_square()).is_compiled
    (library,) = tmp_path.glob("*.so")
    library.unlink()
    library.write_bytes(b"cut short")
    kernel = Kernel(_square())
    assert kernel.is_compiled
    assert _value(kernel) == 9.0


@needs_compiler
def test_where_the_cache_is_no_folder_the_virtual_machine_serves(tmp_path, monkeypatch):
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path / "file" / "cache"))
    (tmp_path / "file").write_text("in the way")
    kernel = Kernel(_square())
    assert not kernel.is_compiled
    assert _value(kernel) == 9.0
