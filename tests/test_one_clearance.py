"""One meaning of clearance and of status: the same number and the same word in every place that tells them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import vgtm_qp as vq
from vgtm_qp.cli import main
from vgtm_qp.comparison.row import make_row
from vgtm_qp.export.html import html_text
from vgtm_qp.live.session import Session
from vgtm_qp.verify.clearance import RESOLUTION

RADIUS = 0.03
SAME = 1e-9
SHAPES = {
    "box": {"shape": "box", "size": 0.5},
    "cylinder": {"shape": "cylinder", "radius": 0.3, "height": 0.7, "rotation_vector": [0.3, 0.2, 0.0]},
    "sphere": {"shape": "sphere", "radius": 0.3},
    "mesh": {"shape": "mesh", "file": "part.stl"},
}
SHALLOW = {"box": 0.847, "cylinder": 0.857, "sphere": 0.854, "mesh": 0.843}
"""Where the part stands beside the arm, m, so that a member hits it and its axis stays outside."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a closed mesh."""
    import trimesh

    path = tmp_path_factory.mktemp("meshes")
    trimesh.creation.icosphere(1, 0.3).export(path / "part.stl")
    return path


@pytest.fixture(scope="module", params=[(shape, is_deep) for shape in SHAPES for is_deep in (True, False)])
def maneuver(request, folder):
    """Return a maneuver of a method without limits that goes through an obstacle, or hits its surface."""
    shape, is_deep = request.param
    obstacle = {"name": "part", "center": [1.1, 0.0 if is_deep else SHALLOW[shape], 1.9], **SHAPES[shape]}
    if shape == "mesh":
        obstacle["file"] = str(folder / "part.stl")
    problem = vq.Problem.from_dict(
        {
            "name": "through a part",
            "truss": {"module": "octahedral", "bays": 3, "member_radius": RADIUS},
            "maneuver": {"steps": 12, "waypoint": [{"time": 4.0, "position": [1.2, 0.0, 1.7]}]},
            "clearance": {"safe": 0.05, "influence": 0.5},
            "obstacle": [obstacle],
            "method": {"name": "pseudoinverse", "correct": True},
        }
    )
    return vq.solve(problem)


def test_every_place_tells_the_same_clearance(maneuver, tmp_path, capsys):
    certificate, summary = maneuver.certificate, maneuver.summary()
    at = float(maneuver.clearance.min())
    # Through its middle the axis of a member goes inside; beside that only its surface does.
    is_deep = maneuver.manifest["problem"]["obstacle"][0]["center"][1] == 0.0
    assert at == -RADIUS if is_deep else -RADIUS < at < 0.0
    assert certificate.clearance.value == pytest.approx(at, abs=SAME)
    assert certificate.array_error.ok
    least = maneuver.least_clearance
    assert at - 0.05 < least <= at
    assert certificate.clearance_between.value == pytest.approx(least, abs=SAME)
    assert summary["min_clearance"] == summary["min_clearance_between"] == least
    assert make_row("", "", maneuver).least_clearance == least
    fine = _between(maneuver)
    assert least <= fine + SAME
    assert least >= fine - RESOLUTION - 2e-3

    k = int(np.argmin(maneuver.clearance))
    session = Session(vq.Problem.from_dict(maneuver.manifest["problem"]))
    session.put_at(maneuver.time[k], maneuver.configurations[k], maneuver.control_vertices[k])
    assert session.reading().clearance == pytest.approx(at, abs=SAME)
    (axes,) = maneuver.plot_clearance().axes
    drawn = next(line for line in axes.lines if line.get_label() == "to obstacles").get_ydata()
    assert np.min(drawn) == pytest.approx(1000.0 * at, abs=1e-6)

    file = tmp_path / "result.npz"
    maneuver.save(file)
    assert main(["verify", str(file), "--json"]) == 4
    entry = json.loads(capsys.readouterr().out)["results"][0]
    assert entry["certificate"]["clearance_between"]["value"] == pytest.approx(least, abs=SAME)
    assert vq.load_result(file).summary()["min_clearance"] == least


def _between(maneuver):
    """Return the least clearance at many instants between the states, by the library's distances."""
    problem = vq.Problem.from_dict(maneuver.manifest["problem"])
    setup = vq.Resolver(problem).setup
    steps = zip(maneuver.nodes[:-1], maneuver.nodes[1:], strict=True)
    shares = np.linspace(0.0, 1.0, 9)
    return min(
        setup.least_clearance(before + share * (after - before), 0.0, "obstacles")
        for before, after in steps
        for share in shares
    )


def test_what_breaks_what_was_asked_is_nowhere_called_solved(maneuver, tmp_path, monkeypatch, capsys):
    assert maneuver.reached == 1.0
    assert not maneuver.certificate.ok
    assert maneuver.status == maneuver.manifest["status"] == maneuver.summary()["status"] == "infeasible"
    assert str(maneuver).startswith("through a part: infeasible, 100 % of the path")
    assert not any("status" in line for line in maneuver.certificate.contradictions)
    row = make_row("", "", maneuver)
    assert (row.status, row.solved, row.kept, row.reached) == ("infeasible", False, False, 1.0)
    assert "(infeasible)</title>" in html_text(maneuver)

    monkeypatch.chdir(tmp_path)
    maneuver.save("result.npz")
    loaded = vq.load_result("result.npz")
    assert loaded.status == "infeasible"
    assert loaded.certificate == maneuver.certificate
    assert main(["verify", "result.npz", "--json"]) == 4
    assert json.loads(capsys.readouterr().out)["results"][0]["status"] == "infeasible"
    assert main(["verify", "result.npz"]) == 4
    assert "result.npz: infeasible, VERIFICATION FAILED" in capsys.readouterr().out


def test_the_word_follows_the_certificate(maneuver):
    """A file of an earlier version says solved; a certificate that passes makes it so again."""
    earlier = replace(maneuver, manifest={**maneuver.manifest, "status": "solved"})
    assert earlier.status == "infeasible"
    unverified = replace(maneuver, manifest={**maneuver.manifest, "status": "solved", "certificate": None})
    assert unverified.status == "solved"
    assert unverified.with_certificate(maneuver.certificate).status == "infeasible"
    measures = {name: replace(measure, bound=None) for name, measure in maneuver.certificate.measures.items()}
    passing = replace(maneuver.certificate, contradictions=(), **measures)
    assert earlier.with_certificate(passing).status == "solved"


def test_the_command_says_infeasible_and_gives_4(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = ["solve", "five_bay_two_cubes", "--method", "pseudoinverse", "--steps", "15"]
    assert main([*command, "--json"]) == 4
    summary = json.loads(capsys.readouterr().out)
    assert (summary["status"], summary["verified"], summary["reached"]) == ("infeasible", False, 1.0)
    assert summary["min_clearance"] == summary["min_clearance_between"] == pytest.approx(-RADIUS, abs=SAME)
    assert main(command) == 4
    out = capsys.readouterr().out
    assert "infeasible, VERIFICATION FAILED" in out
    assert "solved" not in out.lower().replace("five_bay", "")


def test_a_result_without_obstacles_has_no_clearance():
    maneuver = vq.solve(vq.load_problem("five_bay_free").replace({"maneuver.steps": 5}))
    assert maneuver.status == "solved"
    assert maneuver.least_clearance is None
    assert maneuver.summary()["min_clearance"] is None
