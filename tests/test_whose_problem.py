"""What a result is held against: an edited manifest passes for its own problem, and fails for the real one."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import vgtm_qp as vq
from vgtm_qp.arm.build import make_arm
from vgtm_qp.arm.truss.arm import TrussArm
from vgtm_qp.arm.truss.build import build_truss
from vgtm_qp.cli.app import main
from vgtm_qp.maneuver.maneuver import Maneuver
from vgtm_qp.problem.truss import ModuleTruss, TetrahedralTruss
from vgtm_qp.result.manifest import problem_digests
from vgtm_qp.verify.arm import RecordedArm
from vgtm_qp.verify.truss_table import table_contradictions

PROBLEM = """
schema_version = 1
name = "held"
[truss]
module = "octahedral"
bays = 3
rate = 0.5
[maneuver]
steps = 4
[[maneuver.waypoint]]
time = 4.0
position = [0.3, 0.0, 2.4]
[[obstacle]]
name = "ball"
shape = "sphere"
center = [2.0, 0.0, 2.0]
radius = 0.3
"""


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Maneuver]:
    file = tmp_path_factory.mktemp("held") / "held.toml"
    file.write_text(PROBLEM)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VGTM_CC", "none")
        return file, vq.solve(vq.load_problem(file))


def edited(maneuver: Maneuver, edit: Callable[[dict[str, Any]], Any], *, cover: bool = True) -> Maneuver:
    """The maneuver with an edited manifest, whose digests fit it where `cover`."""
    manifest = copy.deepcopy(maneuver.manifest)
    edit(manifest)
    if cover:
        fitting = problem_digests(manifest["problem"])["problem"]
        manifest["problem_digests"]["problem"] = fitting
    return replace(maneuver, manifest=manifest)


def widen(manifest: dict[str, Any]) -> None:
    manifest["problem"]["truss"]["stroke"] = [0.1, 9.0]
    moving = manifest["arm"]["actuated"]
    strokes = zip(manifest["arm"]["stroke"], moving, strict=True)
    manifest["arm"]["stroke"] = [[0.1, 9.0] if moves else old for old, moves in strokes]


EDITS: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "obstacles": (lambda m: m["problem"].update(obstacle=[]), "obstacle"),
    "strokes": (widen, "truss.stroke"),
    "rates": (
        lambda m: (
            m["problem"]["truss"].update(rate=9.0),
            m["arm"].update(rate=[None if r is None else 9.0 for r in m["arm"]["rate"]]),
        ),
        "truss.rate",
    ),
    "self-collision": (
        lambda m: m["problem"]["clearance"].update(self_collision=False),
        "clearance.self_collision",
    ),
    "mode": (lambda m: m["problem"]["end_effector"].update(mode="elastic"), "end_effector.mode"),
    "waypoints": (
        lambda m: m["problem"]["maneuver"]["waypoint"][0].update(position=[0.0, 0.0, 2.4]),
        "maneuver.waypoint[0].position",
    ),
    "name": (lambda m: m["problem"].update(name="other"), "name"),
}


def test_the_real_problem_accepts_its_own_maneuver(solved: tuple[Path, Maneuver]) -> None:
    file, maneuver = solved
    assert maneuver.certificate is not None
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    found = vq.verify(maneuver, problem=vq.load_problem(file))
    assert found.ok, found.failures()
    assert not [line for line in found.notes if "in the result" in line]


@pytest.mark.parametrize("name", EDITS)
def test_an_edited_manifest_fails_for_the_real_problem(name: str, solved: tuple[Path, Maneuver]) -> None:
    file, maneuver = solved
    edit, key = EDITS[name]
    found = vq.verify(edited(maneuver, edit), problem=vq.load_problem(file))
    assert any(line.startswith(f"{key}") for line in found.contradictions), found.contradictions


@pytest.mark.parametrize("name", EDITS)
def test_an_edited_problem_no_longer_has_its_digest(name: str, solved: tuple[Path, Maneuver]) -> None:
    found = vq.verify(edited(solved[1], EDITS[name][0], cover=False))
    assert any("altered" in line for line in found.contradictions)


def test_obstacles_that_were_dropped_count_again(solved: tuple[Path, Maneuver]) -> None:
    file, maneuver = solved
    in_the_way = vq.load_problem(file).replace(
        {"obstacle": [{"name": "wall", "shape": "box", "center": [0.0, 0.0, 1.5], "size": 0.5}]}
    )
    found = vq.verify(maneuver, problem=in_the_way)
    assert not found.clearance.ok
    assert vq.verify(maneuver).ok


def test_how_it_was_solved_may_differ(solved: tuple[Path, Maneuver]) -> None:
    file, maneuver = solved
    real = vq.load_problem(file).replace({"method.solver": "osqp", "maneuver.steps": 9})
    found = vq.verify(maneuver, problem=real)
    assert found.ok, found.failures()
    assert {line.split(":")[0] for line in found.notes} >= {"method.solver", "maneuver.steps"}


def test_default_strokes_are_those_of_the_module(solved: tuple[Path, Maneuver]) -> None:
    def widen_record(manifest: dict[str, Any]) -> None:
        widen(manifest)
        del manifest["problem"]["truss"]["stroke"]

    maneuver = solved[1]
    assert "stroke" not in maneuver.manifest["problem"]["truss"]
    found = vq.verify(edited(maneuver, widen_record))
    assert any("record's stroke differs from the problem's" in line for line in found.contradictions)


def moved(record: dict[str, Any]) -> None:
    record["home"] = [[x + 0.5, y, z] for x, y, z in record["home"]]


RECORD_EDITS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "home": moved,
    "rate": lambda r: r.update(rate=[None] * len(r["rate"])),
    "acceleration": lambda r: r.update(acceleration=[1.0] * len(r["rate"])),
    "radius": lambda r: r.update(radius=[0.0] * len(r["radius"])),
    "actuated": lambda r: r.update(actuated=[not moves for moves in r["actuated"]]),
    "base": lambda r: r.update(base=[0, 1, 3]),
    "tip": lambda r: r["tip"].update(nodes=[0, 1, 2]),
}


@pytest.mark.parametrize("name", RECORD_EDITS)
def test_a_record_of_another_arm_is_found(name: str, solved: tuple[Path, Maneuver]) -> None:
    found = vq.verify(edited(solved[1], lambda manifest: RECORD_EDITS[name](manifest["arm"])))
    assert any("arm record" in line for line in found.contradictions), found.failures()


TABLES = [
    *(
        ModuleTruss(module=module, bays=bays, joint_offset=offset, longeron=1.1, batten=1.0)
        for module in ("octahedral", "double-octahedral", "hexapod", "longeron")
        for bays, offset in ((1, 0.0), (3, 0.05))
    ),
    TetrahedralTruss(module="tetrahedral", bays=3, longeron=1.2, batten=1.05, actuated=(1, 3)),
    TetrahedralTruss(module="tetrahedral", bays=2, locked=("L1-1",)),
]


@pytest.mark.parametrize("table", TABLES, ids=lambda table: f"{table.module}-{table.bays}")
def test_the_expected_truss_is_the_one_that_is_built(table: ModuleTruss | TetrahedralTruss) -> None:
    truss = build_truss(table)
    record = json.loads(json.dumps(TrussArm(truss).record()))
    data = table.model_dump(mode="json", exclude_none=True)
    assert list(table_contradictions(RecordedArm(record, truss.members), data)) == []


@pytest.mark.parametrize("name", [name for name in vq.bundled_problems() if vq.load_problem(name).truss])
def test_records_of_the_bundled_problems_are_those_of_their_tables(name: str) -> None:
    problem = vq.load_problem(name)
    arm = make_arm(problem)
    assert isinstance(arm, TrussArm)
    recorded = RecordedArm(json.loads(json.dumps(arm.record())), arm.truss.members)
    assert list(table_contradictions(recorded, problem.to_dict()["truss"])) == []


def test_a_path_file_that_changed_is_named(tmp_path: Path, solved: tuple[Path, Maneuver]) -> None:
    path = tmp_path / "way.csv"
    path.write_text("t,x,y,z\n1,0.05,0,2.44\n2,0.1,0,2.44\n")
    file = tmp_path / "path.toml"
    start = PROBLEM.index("[maneuver]")
    table = '[maneuver]\npath = "way.csv"\napproach_steps = 2\n'
    file.write_text(PROBLEM[:start] + table + PROBLEM[PROBLEM.index("[[obstacle]]") :])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VGTM_CC", "none")
        maneuver = vq.solve(vq.load_problem(file))
    assert vq.verify(maneuver).ok
    path.write_text("t,x,y,z\n1,0.05,0,2.44\n2,0.1,0,2.4400001\n")
    for problem in (None, vq.load_problem(file)):
        found = vq.verify(maneuver, problem=problem)
        assert any("maneuver.path" in line for line in found.contradictions)


def test_the_command_says_what_it_held_a_result_against(
    tmp_path: Path, solved: tuple[Path, Maneuver], capsys: pytest.CaptureFixture[str]
) -> None:
    file, maneuver = solved
    honest, forged = tmp_path / "honest.npz", tmp_path / "forged.npz"
    maneuver.save(honest)
    edited(maneuver, EDITS["obstacles"][0]).save(forged)
    assert main(["verify", str(honest)]) == 0
    assert "held against the problem in the result itself, SHA-256 " in capsys.readouterr().out
    assert main(["verify", str(honest), "--problem", str(file)]) == 0
    assert "the file that it was solved from" in capsys.readouterr().out
    assert main(["verify", str(forged), "--problem", str(file), "--json"]) == 4
    entry = json.loads(capsys.readouterr().out)["results"][0]
    assert not entry["verified"]
    assert entry["held_against"]["problem"] == str(file)
    assert entry["held_against"]["sha256"] == entry["held_against"]["solved_from"]
    assert main(["verify", str(honest), "--problem", "none.toml"]) == 2
