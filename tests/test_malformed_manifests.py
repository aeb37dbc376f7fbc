"""Manifests with a wrong value anywhere: exit code 0, 3 or 4, one message with the key, and never a traceback."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vgtm_qp as vq
from vgtm_qp.cli.app import main
from vgtm_qp.result.file import content_digest
from vgtm_qp.result.manifest import stored_problem

WRONG: tuple[Any, ...] = (
    None,
    True,
    -1,
    10**30,
    10**400,
    0.5,
    "text",
    [],
    {},
    [None],
    [[1.0], [2.0, 3.0]],
    {"a": 1},
)
NAMES = ("five_bay_free", "snake_past_a_cube")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("malformed")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VGTM_CC", "none")
        for name in NAMES:
            problem = vq.load_problem(name).replace({"maneuver.steps": 50})
            waypoints = [{"time": 0.2, "position": [0.02, 0.0, waypoint_height(name)]}]
            problem = problem.replace({"maneuver.steps": 2, "maneuver.waypoint": waypoints})
            vq.solve(problem, verify=False).save(folder / f"{name}.npz")
    return {name: folder / f"{name}.npz" for name in NAMES}


def waypoint_height(name: str) -> float:
    resolver = vq.Resolver(vq.load_problem(name))
    return float(resolver.tip()[0][2])


def places(value: Any, place: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Every place of JSON data; of long lists the first and the last entry."""
    if place:
        yield place
    if isinstance(value, dict):
        for key in value:
            yield from places(value[key], (*place, key))
    elif isinstance(value, list) and value:
        for k in {0, len(value) - 1}:
            yield from places(value[k], (*place, k))


def write(path: Path, content: dict[str, Any], manifest: dict[str, Any]) -> None:
    unsigned = {key: value for key, value in manifest.items() if key != "digest"}
    manifest = {**unsigned, "digest": content_digest(content, unsigned)}
    np.savez(path, **content, manifest=np.array(json.dumps(manifest)))


@pytest.mark.parametrize("name", NAMES)
def test_a_wrong_value_anywhere_is_refused_with_its_key(
    name: str,
    files: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    rng: np.random.Generator,
) -> None:
    with np.load(files[name]) as file:
        content = dict(file)
    manifest = json.loads(str(content.pop("manifest")))
    every = list(places(manifest))
    chosen = [every[k] for k in rng.permutation(len(every))[:15]]
    path = tmp_path / "wrong.npz"
    refused = 0
    for place in chosen:
        changed = copy.deepcopy(manifest)
        table: Any = changed
        for part in place[:-1]:
            table = table[part]
        if rng.random() < 0.2:
            del table[place[-1]]
            value: Any = "nothing"
        else:
            table[place[-1]] = value = WRONG[rng.integers(len(WRONG))]
        write(path, content, changed)
        code = main(["verify", str(path), "--json"])
        out, err = capsys.readouterr()
        assert code in (0, 3, 4), (place, str(value)[:60], err)
        entry = json.loads(out)["results"][0]
        if "error" in entry:
            refused += 1
            key = str(place[0]).replace("_", " ")
            assert key in entry["error"].replace("_", " "), (place, entry["error"])
            assert err.count("vgtm: ") == 1
    assert refused


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        (("curve", "breaks"), [0.0, 0.0], "manifest.curve.breaks"),
        (("curve", "extraction"), "text", "manifest.curve.extraction"),
        (("curve", "stations"), [[99] * 3] * 6, "manifest.curve.stations"),
        (("curve", "held"), 1, "manifest.curve.held"),
        (("curve", "nodes"), [True], "manifest.curve.nodes"),
        (("arm", "actuated"), [1, 0], "manifest.arm.actuated"),
        (("arm", "home"), {"x": 0.0}, "manifest.arm.home"),
        (("arm", "tip"), [1], "manifest.arm.tip"),
        (("problem", "truss", "bays"), "five", "manifest.problem.truss.bays"),
        (("problem", "clearance", "safe"), [0.1], "manifest.problem.clearance.safe"),
        (("problem", "obstacle"), 3, "manifest.problem.obstacle"),
        (("certificate",), {"clearance": 3}, "certificate"),
        (("recovered",), [{"pair": 3}], "manifest.recovered"),
        (("meshes",), [1], "manifest.meshes"),
    ],
)
def test_the_key_is_named(
    key: tuple[str, ...], value: Any, message: str, files: dict[str, Path], tmp_path: Path, capsys: Any
) -> None:
    with np.load(files["five_bay_free"]) as file:
        content = dict(file)
    manifest = json.loads(str(content.pop("manifest")))
    table = manifest
    for part in key[:-1]:
        table = table[part]
    table[key[-1]] = value
    write(tmp_path / "wrong.npz", content, manifest)
    assert main(["verify", str(tmp_path / "wrong.npz")]) == 4
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("former", "present"),
    [
        ({"hard_tracking": True}, {"tracking_mode": "hard"}),
        ({"hard_tracking": False, "variant": "damped"}, {"tracking_mode": "elastic", "variant": "damped"}),
        ({"hard_tracking": False, "tracking": "recursive", "solver": "osqp"}, {"tracking_mode": "exact"}),
        ({"hard_tracking": False, "name": "pseudoinverse", "tracking": "none"}, {"tracking_mode": "exact"}),
    ],
)
def test_results_of_earlier_versions_are_read_and_verified(files, tmp_path, former, present):
    """Their problems have a former key, and keys that the method had no use for."""
    result = vq.load_result(files["five_bay_free"])
    problem = copy.deepcopy(result.manifest["problem"])
    del problem["method"]["tracking_mode"]
    problem["method"].update(former)
    manifest = {
        key: result.manifest[key] for key in result.manifest if key not in ("curve", "problem_digests")
    }
    path = tmp_path / "earlier.npz"
    replace(result, manifest={**manifest, "problem": problem}).save(path)
    assert vq.load_result(path).manifest["problem"] == problem
    assert vq.verify(vq.load_result(path)).ok
    read = stored_problem(problem).to_dict()["method"]
    assert read.items() >= present.items()
