"""Mutated files of every kind through every command that takes them; the helper's own script does many more."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from mutations import KINDS, SCENE, Bench

from vgtm_qp.cli import main


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VGTM_CC", "none")
        return Bench(tmp_path_factory.mktemp("mutated"))


@pytest.mark.parametrize("kind", KINDS)
def test_a_mutated_file_is_refused_in_words_or_served(
    kind: str, bench: Bench, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser")
    pytest.importorskip("mujoco")
    monkeypatch.setenv("VGTM_CC", "none")
    for seed in rng.integers(2**32, size=10).tolist():
        getattr(bench, kind)(np.random.default_rng(seed))


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
def test_numbers_that_are_none_are_refused_wherever_they_stand(
    value: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = SCENE.splitlines()
    for k, line in enumerate(lines):
        if re.search(r"= \[?-?\d", line) and "version" not in line:
            wrong = [
                *lines[:k],
                re.sub(r"(?<== )(\[?)-?\d+(\.\d+)?", rf"\g<1>{value}", line, count=1),
                *lines[k + 1 :],
            ]
            file = tmp_path / "altered.toml"
            file.write_text("\n".join(wrong), encoding="utf-8")
            assert main(["check", str(file)]) == 2, line
            assert "expected" in capsys.readouterr().err
