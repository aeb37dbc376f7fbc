"""The result file: what is written comes back, and what is not whole is refused with its reason."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import textwrap
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import good_maneuver, maneuver_of, swing, tripod

from vgtm_qp.errors import ResultError
from vgtm_qp.maneuver.maneuver import Maneuver, load_result
from vgtm_qp.result.certificate import Certificate, Measure
from vgtm_qp.result.file import content_digest
from vgtm_qp.result.manifest import SCHEMA_VERSION
from vgtm_qp.verify import verify

FIXED = good_maneuver()


def raw(path: Path) -> dict[str, Any]:
    with np.load(path, allow_pickle=False) as file:
        return dict(file)


def rewrite(path: Path, *, sign: bool = True, manifest: dict[str, Any] | None = None, **arrays: Any) -> Path:
    """Write the file again with other arrays, with a digest that fits them where `sign`."""
    content = raw(path)
    record = json.loads(str(content.pop("manifest")))
    content.update(arrays)
    record.update(manifest or {})
    if sign:
        record["digest"] = content_digest(content, {k: v for k, v in record.items() if k != "digest"})
    np.savez(path, **content, manifest=np.array(json.dumps(record)))
    return path


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    return good_maneuver().save(tmp_path / "out" / "result.npz")


@pytest.mark.smoke
def test_round_trip_keeps_every_bit(saved: Path) -> None:
    original, loaded = good_maneuver(), load_result(saved)
    assert original.arrays.keys() == loaded.arrays.keys()
    for name, array in original.arrays.items():
        assert array.dtype == loaded.arrays[name].dtype, name
        np.testing.assert_array_equal(array, loaded.arrays[name])
    digest = loaded.manifest.pop("digest")
    assert loaded.manifest == original.manifest
    assert len(digest) == 64


def test_optional_targets_and_certificate_survive(tmp_path: Path) -> None:
    maneuver = good_maneuver()
    pointing = np.tile([0.0, 0.0, 1.0], (len(maneuver.time), 1))
    certificate = verify(maneuver)
    path = (
        replace(maneuver, tip_target_pointing=pointing).with_certificate(certificate).save(tmp_path / "r.npz")
    )
    loaded = Maneuver.load(path)
    np.testing.assert_array_equal(loaded.tip_target_pointing, pointing)
    assert loaded.tip_target_rotation is None
    assert loaded.certificate == certificate


def test_arrays_are_read_only_copies() -> None:
    nodes, time = swing()
    maneuver = maneuver_of(nodes, time, tripod())
    with pytest.raises(ValueError, match="read-only"):
        maneuver.nodes[0, 0, 0] = 1.0
    for array in maneuver.arrays.values():
        with pytest.raises(ValueError, match="WRITEABLE"):
            array.setflags(write=True)
    nodes[0, 0, 0] += 1.0
    assert maneuver.nodes[0, 0, 0] != nodes[0, 0, 0]


def test_summary_has_the_keys_of_the_contract_and_is_strict_json(tmp_path: Path) -> None:
    maneuver = good_maneuver()
    maneuver = maneuver.with_certificate(verify(maneuver))
    summary = maneuver.summary(tmp_path / "r.npz")
    limits = {"max_member_error", "max_stroke_violation", "max_rate_violation", "max_tip_error"}
    outcome = {"name", "status", "reached", "steps", "bays", "method", "solver", "min_clearance"}
    assert limits | outcome | {"step_time", "setup_time", "blocked_by", "result"} <= summary.keys()
    assert {"median", "p95", "p99", "phases"} <= summary["step_time"].keys()
    assert summary["step_time"]["median"] == 1e-3
    assert summary["step_time"]["phases"] == {"QP": 4e-4, "distance": 4e-4}
    assert summary["min_clearance"] is None
    assert summary["verified"] is True
    assert summary["steps"] == 10
    json.dumps(summary, allow_nan=False)


def test_a_maneuver_is_printed_as_one_paragraph() -> None:
    maneuver = good_maneuver()
    name = maneuver.summary()["name"]
    assert str(maneuver) == f"{name}: solved, 100 % of the path in 10 steps. Not verified yet."
    assert repr(maneuver) == f"<Maneuver {name!r}: solved, 10 steps, 100 %>"
    certificate = verify(maneuver)
    assert str(maneuver.with_certificate(certificate)).endswith(" Verified.")
    wrong = replace(certificate, tip_error=Measure(0.5, "m", 1e-6))
    assert str(maneuver.with_certificate(wrong)).endswith(
        "VERIFICATION FAILED: tip error: 0.5 m  (at most 1e-06)."
    )
    nodes, time = swing()
    stopped = maneuver_of(nodes[:1], time[:1], tripod(), status="blocked", reached=0.25)
    stopped = replace(stopped, manifest={**stopped.manifest, "blocked_by": ["a / b"]})
    assert " blocked, 25 % of the path in 0 steps. Stopped by a / b." in str(stopped)


def test_summary_of_a_maneuver_without_steps_or_certificate() -> None:
    nodes, time = swing()
    maneuver = maneuver_of(nodes[:1], time[:1], tripod(), status="infeasible", reached=0.0)
    summary = maneuver.summary()
    assert summary["step_time"]["median"] is None
    assert summary["verified"] is None
    assert summary["max_tip_error"] is None


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9, 0.999])
def test_cut_file_is_refused(saved: Path, kept: float) -> None:
    content = saved.read_bytes()
    saved.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(ResultError, match="result\\.npz"):
        load_result(saved)


def test_a_header_whose_brackets_never_close_is_refused(saved: Path) -> None:
    with zipfile.ZipFile(saved) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(saved, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content.replace(b"'shape': (", b"'shap: (((", 1))
    with pytest.raises(ResultError, match="cannot be read"):
        load_result(saved)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_flipped_byte_is_refused_or_changes_nothing(data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = FIXED.save(Path(folder) / "result.npz")
        content = bytearray(path.read_bytes())
        place = data.draw(st.integers(0, len(content) - 1))
        content[place] ^= data.draw(st.integers(1, 255))
        path.write_bytes(bytes(content))
        # Bytes that no reader looks at, such as a date, may change; no value may.
        try:
            loaded = load_result(path)
        except ResultError:
            return
        for name, array in FIXED.arrays.items():
            np.testing.assert_array_equal(array, loaded.arrays[name])


@pytest.mark.smoke
def test_altered_array_is_refused(saved: Path) -> None:
    nodes = raw(saved)["nodes"]
    nodes[3, 4, 0] += 1e-6
    with pytest.raises(ResultError, match="digest"):
        load_result(rewrite(saved, sign=False, nodes=nodes))


def test_swapped_rows_of_one_array_are_refused(saved: Path) -> None:
    content = raw(saved)
    swapped = rewrite(saved, sign=False, step_time=content["clearance"], clearance=content["step_time"])
    with pytest.raises(ResultError):
        load_result(swapped)


@pytest.mark.smoke
def test_altered_manifest_is_refused(saved: Path) -> None:
    with pytest.raises(ResultError, match="digest"):
        load_result(rewrite(saved, sign=False, manifest={"reached": 0.5}))


def test_other_version_says_which_it_reads(saved: Path) -> None:
    with pytest.raises(ResultError, match=f"version 99; this package reads version {SCHEMA_VERSION}"):
        load_result(rewrite(saved, manifest={"schema_version": 99}))


def test_pickled_objects_are_never_read(saved: Path) -> None:
    with pytest.raises(ResultError, match="member_names"):
        load_result(rewrite(saved, member_names=np.array([{"a": 1}] * 6, dtype=object)))


@pytest.mark.parametrize("name", ["time", "nodes", "members", "clearance", "phase_time", "tip_rotation"])
def test_missing_array_is_named(saved: Path, name: str) -> None:
    content = raw(saved)
    del content[name]
    np.savez(saved, **content)
    with pytest.raises(ResultError, match=f"array {name} is missing"):
        load_result(saved)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("nodes", np.zeros((11, 5, 2)), r"shape \(11, 5, 2\); expected \(T = 11, N, 3\)"),
        ("time", np.zeros(11), "does not increase at row 1"),
        ("time", np.arange(11), "holds int64"),
        ("clearance", np.full(11, np.nan), "not a number, row 0"),
        ("tip_position", np.full((11, 3), np.inf), "not a number, row 0"),
        ("members", np.full((6, 2), 7), r"a node outside 0\.\.4"),
        ("member_actuated", np.zeros(6), "expected kind b"),
        ("stray", np.zeros(3), "stray is not one"),
    ],
)
def test_malformed_array_is_named(saved: Path, name: str, value: Any, message: str) -> None:
    with pytest.raises(ResultError, match=message):
        load_result(rewrite(saved, **{name: value}))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"schema_version": 1, "reached": NaN}', "NaN"),
        ('{"schema_version": 1', "not JSON"),
        ("[1]", "not a JSON object"),
        ('{"schema_version": 1}', "lacks problem, arm"),
    ],
)
def test_malformed_manifest_is_named(saved: Path, text: str, message: str) -> None:
    content = raw(saved)
    content["manifest"] = np.array(text)
    np.savez(saved, **content)
    with pytest.raises(ResultError, match=message):
        load_result(saved)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"status": "done"}, "expected one of solved, blocked, infeasible"),
        ({"reached": 1.5}, "from 0 to 1"),
        ({"blocked_by": "cube"}, "blocked_by is 'cube'; expected a list of names"),
        ({"certificate": {"ok": True}}, "certificate is not complete"),
    ],
)
def test_manifest_values_are_checked(saved: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(ResultError, match=message):
        load_result(rewrite(saved, manifest=change))


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="no such file"):
        load_result(tmp_path / "none.npz")
    with zipfile.ZipFile(tmp_path / "other.npz", "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(ResultError):
        load_result(tmp_path / "other.npz")
    np.savez(tmp_path / "arrays.npz", a=np.zeros(3))
    with pytest.raises(ResultError, match="no manifest"):
        load_result(tmp_path / "arrays.npz")


def test_not_json_is_refused_at_once() -> None:
    maneuver = good_maneuver()
    for value in (float("nan"), float("inf"), object()):
        with pytest.raises(ResultError, match="strict JSON"):
            replace(maneuver, manifest={**maneuver.manifest, "extra": value})


def test_failed_write_leaves_the_old_file_and_no_scratch(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = saved.read_bytes()

    def fail(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(ResultError, match="No space left"):
        good_maneuver().save(saved)
    assert saved.read_bytes() == before
    assert [entry.name for entry in saved.parent.iterdir()] == [saved.name]


def test_process_killed_while_writing_leaves_the_old_or_the_new_file(saved: Path) -> None:
    script = f"""
        import os, sys
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        from synthetic import good_maneuver
        maneuver = good_maneuver()
        print("ready", flush=True)
        while True:
            maneuver.save({str(saved)!r})
    """
    for pause in (0.0, 0.013, 0.05):
        child = subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(script)],
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
        )
        assert child.stdout is not None
        assert child.stdout.readline().strip() == b"ready"
        try:
            child.wait(pause)
        except subprocess.TimeoutExpired:
            child.kill()
        child.wait()
        child.stdout.close()
        assert load_result(saved).steps == 10


def test_what_a_killed_save_left_behind_goes_with_the_next_one(saved: Path) -> None:
    names = [
        ".result.npz.0123456789abcdef.tmp",
        ".result.npz.fedcba9876543210.tmp",
        ".other.npz.0123456789abcdef.tmp",
    ]
    for name in names:
        saved.with_name(name).write_bytes(b"cut")
    for name in (names[0], names[2]):
        os.utime(saved.with_name(name), (0.0, 0.0))
    good_maneuver().save(saved)
    assert {entry.name for entry in saved.parent.iterdir()} == {saved.name, *names[1:]}


def test_certificate_survives_json() -> None:
    certificate = verify(good_maneuver())
    text = json.dumps(certificate.to_dict(), allow_nan=False)
    assert Certificate.from_dict(json.loads(text)) == certificate


def test_measures_that_are_not_finite() -> None:
    assert Measure(np.inf, "m", 0.1, "least").value is None
    for value in (np.nan, np.inf, -np.inf):
        measure = Measure(value, "m", 0.1, "most")
        assert not measure.ok
        assert np.isfinite(measure.value)
    assert not Measure(-np.inf, "m", 0.1, "least").ok
    assert not Measure(np.nan, "m", 0.1, "least").ok
