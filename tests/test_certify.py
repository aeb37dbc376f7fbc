"""Trajectories of anybody's: what is certified is clear everywhere, and what is not clear never is."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import vgtm_qp as vq
from vgtm_qp.certify.certify import Certifier
from vgtm_qp.cli import main
from vgtm_qp.problem import Problem

SAFE = 0.05
JOINTS = 7


def arm(rng):
    """Seven joints about axes across the arm and along it, 2.1 m long."""
    axes = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    return [
        {
            "name": f"j{k}",
            "axis": axes[int(rng.integers(3))],
            "position": [0.0, 0.0, 0.3],
            "limits": [-2.5, 2.5],
            "rate": 3.0,
            "home": 0.1,
        }
        for k in range(JOINTS)
    ]


def problem_of(joints, obstacles, **clearance):
    return Problem.from_dict(
        {
            "schema_version": 1,
            "arm": {"joint": joints, "tip": [0.0, 0.0, 0.3], "link_radius": 0.04},
            "obstacle": obstacles,
            "clearance": {"safe": SAFE, "self_collision": False, **clearance},
            "maneuver": {"steps": 1, "waypoint": [{"time": 1.0, "position": [0.5, 0.5, 1.5]}]},
        }
    )


def links(chain, q):
    """The ends (P, B, 2, 3) of all links at joint values (P, J)."""
    return chain.ends(chain.placed(np.concatenate([q, np.zeros((len(q), 6))], axis=1))[0])


def to_ball(ends, center, radius):
    """Distances (P, B) from the links, less their radius, to a ball: its centre's from the segments."""
    start, along = ends[..., 0, :], ends[..., 1, :] - ends[..., 0, :]
    share = np.clip(((center - start) * along).sum(-1) / (along * along).sum(-1), 0.0, 1.0)
    return np.linalg.norm(start + share[..., None] * along - center, axis=-1) - radius - 0.04


def ball(center, radius, name="ball"):
    return {"name": name, "shape": "sphere", "center": [float(x) for x in center], "radius": float(radius)}


@pytest.fixture
def scene(rng):
    joints = arm(rng)
    chain = Certifier(problem_of(joints, [])).arm
    return joints, chain


def planted(joints, chain, rng, depth):
    """Two rows and a ball that the arm comes nearest to between them, by `depth` less than it may, m."""
    for _ in range(100):
        before = rng.uniform(-1.0, 1.0, JOINTS)
        after = before + rng.uniform(-0.6, 0.6, JOINTS)
        share = np.linspace(0.0, 1.0, 401)
        ends = links(chain, before + share[:, None] * (after - before))
        k = int(rng.integers(100, 300))
        link = int(rng.integers(3, JOINTS))
        axis = ends[k, link, 1] - ends[k, link, 0]
        aside = np.cross(axis, rng.normal(size=3))
        center = ends[k, link].mean(axis=0) + 0.4 * aside / np.linalg.norm(aside)
        distance = to_ball(ends, center, 0.0).min(axis=1)
        radius = distance.min() - SAFE + depth
        nearest = int(np.argmin(distance))
        if radius > 0.02 and 40 < nearest < 360 and distance[[0, -1]].min() - radius > SAFE + 1e-3:
            return np.stack([before, after]), ball(center, radius)
    pytest.fail("no such motion was found")


@pytest.mark.property
def test_penetrations_between_rows_are_never_certified(scene, rng):
    joints, chain = scene
    for _ in range(60):
        depth = float(10.0 ** rng.uniform(-4.0, -1.7)) + 1e-5
        rows, obstacle = planted(joints, chain, rng, depth)
        verdict = vq.certify(problem_of(joints, [obstacle]), [0.0, 1.0], rows)
        assert not verdict.certified
        finding = min(verdict.violations, key=lambda found: found.value)
        assert (finding.kind, finding.names[1]) == ("clearance", "ball")
        for instant in (finding.start, finding.end):
            ends = links(chain, rows[:1] + instant * (rows[1:] - rows[:1]))
            distance = to_ball(ends, np.array(obstacle["center"]), obstacle["radius"])
            assert distance[0, chain.member_names.index(finding.names[0])] < SAFE
        assert SAFE - 1.05 * depth - 1e-5 <= finding.value < SAFE
        assert verdict.clearance < SAFE


@pytest.mark.property
def test_what_is_clear_by_a_millimetre_is_certified(scene, rng):
    joints, chain = scene
    undecided = 0
    for _ in range(60):
        rows, obstacle = planted(joints, chain, rng, -1e-3)
        verdict = vq.certify(problem_of(joints, [obstacle]), [0.0, 1.0], rows)
        undecided += not verdict.certified
        assert not verdict.violations, str(verdict)
        assert verdict.clearance >= SAFE - 1e-9
    assert undecided == 0


SHAPES = ("sphere", "box", "cylinder")


def obstacle(rng, k):
    common = {
        "name": f"o{k}",
        "shape": SHAPES[k % 3],
        "center": (rng.uniform(0.5, 1.6) * direction(rng)).tolist(),
        "rotation_vector": rng.normal(size=3).tolist(),
    }
    if common["shape"] == "sphere":
        del common["rotation_vector"]
        return {**common, "radius": 0.15}
    if common["shape"] == "box":
        return {**common, "size": [0.2, 0.3, 0.25]}
    return {**common, "radius": 0.12, "height": 0.4}


def direction(rng):
    x = rng.normal(size=3)
    return x / np.linalg.norm(x)


def apart(points, entry):
    """Distances (K,) of points (K, 3) from a solid obstacle; zero inside."""
    x = points - np.array(entry["center"])
    if entry["shape"] == "sphere":
        return np.maximum(np.linalg.norm(x, axis=1) - entry["radius"], 0.0)
    x = x @ Rotation.from_rotvec(entry["rotation_vector"]).as_matrix()
    if entry["shape"] == "box":
        return np.linalg.norm(np.maximum(np.abs(x) - 0.5 * np.array(entry["size"]), 0.0), axis=1)
    across = np.maximum(np.linalg.norm(x[:, :2], axis=1) - entry["radius"], 0.0)
    return np.hypot(across, np.maximum(np.abs(x[:, 2]) - 0.5 * entry["height"], 0.0))


@pytest.mark.property
def test_random_trajectories_are_judged_as_samples_say(rng):
    seen = {True: 0, False: 0}
    # A third of the trajectories hits one of nine obstacles: that none of forty does is a matter of 1e-7.
    for _ in range(40):
        joints = arm(rng)
        obstacles = [obstacle(rng, k) for k in range(9)]
        rows = np.cumsum(rng.normal(0.0, 0.25, (6, JOINTS)), axis=0)
        problem = problem_of(joints, obstacles)
        verdict = vq.certify(problem, np.arange(6.0), rows)
        chain = Certifier(problem).arm
        x = np.linspace(0.0, 5.0, 501)
        q = np.stack([np.interp(x, np.arange(6.0), column) for column in rows.T], axis=1)
        ends = links(chain, q)
        share = np.linspace(0.0, 1.0, 21)[:, None]
        points = (ends[:, :, None, 0] + share * (ends[:, :, None, 1] - ends[:, :, None, 0])).reshape(-1, 3)
        least = min(float(apart(points, entry).min()) for entry in obstacles) - 0.04
        clear = [finding for finding in verdict.violations if finding.kind == "clearance"]
        if least < SAFE - 1e-9:
            assert clear, (least, str(verdict))
            assert min(finding.value for finding in clear) <= max(least, -0.04) + 0.02
        if not clear and not verdict.undecided:
            assert least >= verdict.clearance - 1e-9
        seen[bool(clear)] += 1
    assert min(seen.values()) > 0


def test_self_collision_between_rows_is_found(rng):
    joints = [
        {"name": f"j{k}", "axis": [0.0, 1.0, 0.0], "position": [0.0, 0.0, 0.3], "home": 0.1} for k in range(7)
    ]
    problem = problem_of(joints, [], self_collision=True, self_safe=0.02)
    folded = np.array([[1.0] * 7, [-1.0] * 7])
    verdict = vq.certify(problem, [0.0, 1.0], [[0.0, 0, 0, 0, 0, 0, 0], [0.3] * 7])
    assert verdict.certified
    assert verdict.self_clearance > 0.02
    verdict = vq.certify(problem, [0.0, 1.0], folded)
    assert {finding.kind for finding in verdict.violations} == {"self-clearance"}


def test_limits_rates_accelerations_and_locks_are_held_against_the_joints():
    joints = [
        {
            "name": f"j{k}",
            "axis": [0.0, 1.0, 0.0],
            "position": [0.0, 0.0, 0.3],
            "limits": [-1.0, 1.0],
            "rate": 0.5,
            "acceleration": 0.6,
            "home": 0.1,
        }
        for k in range(3)
    ]
    problem = problem_of(joints, []).replace({"arm.locked": ["j2"]})
    still = np.tile([0.1, 0.1, 0.1], (5, 1))
    times = np.arange(5.0)
    assert vq.certify(problem, times, still).certified

    def found(place, value):
        rows = still.copy()
        rows[place] = value
        return {
            (f.kind, f.names, round(f.start, 9), f.end) for f in vq.certify(problem, times, rows).violations
        }

    assert found((2, 0), 0.3) == set()
    assert found((4, 0), 0.65) == {("rate", ("j0",), 3.0, 4.0)}
    assert found((4, 1), 1.1) == {
        ("limit", ("j1",), 3.9, 4.0), ("rate", ("j1",), 3.0, 4.0), ("acceleration", ("j1",), 2.0, 4.0),
    }  # fmt: skip
    assert found((2, 0), 0.45) == {("acceleration", ("j0",), 1.0, 3.0)}
    assert found((3, 2), 0.1001) == {("lock", ("j2",), 2.0, 4.0)}


def test_obstacles_that_move_and_a_base_that_moves_count():
    joints = [{"name": f"j{k}", "axis": [0.0, 1.0, 0.0], "position": [0.0, 0.0, 0.3]} for k in range(3)]
    passing = {**ball([-2.0, 0.0, 0.6], 0.1), "velocity": [1.0, 0.0, 0.0]}
    still = np.zeros((2, 3))
    verdict = vq.certify(problem_of(joints, [passing]), [0.0, 4.0], still)
    (finding,) = [f for f in verdict.violations if f.names[0] == "j1"]
    # It touches the clearance at 0.1 + 0.04 + 0.05 m from the arm's axis.
    assert finding.start == pytest.approx(2.0 - 0.19, abs=0.3)
    assert finding.value < 0.0
    assert vq.certify(problem_of(joints, [passing]), [0.0, 1.7], still).certified
    moved = [{"time": 4.0, "position": [2.0, 0.0, 0.0]}]
    wall = problem_of(joints, [ball([1.0, 0.0, 0.6], 0.1)]).replace({"arm.base_motion": moved})
    assert not vq.certify(wall, [0.0, 4.0], still).certified
    assert vq.certify(wall, [0.0, 1.0], still).certified


def test_a_pose_alone_is_certified_or_not():
    joints = [{"name": f"j{k}", "axis": [0.0, 1.0, 0.0], "position": [0.0, 0.0, 0.3]} for k in range(3)]
    problem = problem_of(joints, [ball([0.5, 0.0, 0.6], 0.1)])
    assert vq.certify(problem, [0.0], [[0.0, 0.0, 0.0]]).certified
    assert not vq.certify(problem, [0.0], [[0.0, np.pi / 2, 0.0]]).certified


def test_what_the_solver_makes_is_certified():
    problem = vq.load_problem("snake_past_a_cube").replace({"method.retries": False})
    maneuver = vq.solve(problem)
    verdict = vq.certify(problem, maneuver.time, maneuver.joints)
    assert verdict.clearance >= 0.08 - 1e-4
    assert not [finding for finding in verdict.violations if finding.value < finding.bound - 1e-4]


PROBLEM = """schema_version = 1
[arm]
tip = [0.0, 0.0, 0.3]
joint = [
  { name = "lift", axis = [0.0, 1.0, 0.0], position = [0.0, 0.0, 0.3], limits = [-2.0, 2.0], rate = 1.0, home = 0.1 },
  { name = "turn", axis = [1.0, 0.0, 0.0], position = [0.0, 0.0, 0.3], limits = [-2.0, 2.0], rate = 1.0, home = 0.1 },
  { name = "roll", axis = [0.0, 1.0, 0.0], position = [0.0, 0.0, 0.3], limits = [-2.0, 2.0], rate = 1.0, home = 0.1 },
]
[maneuver]
steps = 2
waypoint = [{ time = 2.0, position = [0.1, 0.1, 1.1] }]
[[obstacle]]
name = "ball"
shape = "sphere"
center = [0.6, 0.0, 0.7]
radius = 0.1
"""
GOOD = "t,turn,lift,roll\n0,0,0,0\n1,0.1,0,0\n2,0.2,0,0.1\n"
HITS = "t,lift,turn,roll\n0,-0.4,0,0\n4,2,0,0\n"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.toml").write_text(PROBLEM)
    (tmp_path / "good.csv").write_text(GOOD)
    (tmp_path / "hits.csv").write_text(HITS)
    return tmp_path


def test_the_command_says_what_it_proves(folder, capsys):
    assert main(["certify", "arm.toml", "good.csv"]) == 0
    assert "good.csv: certified, clearance at least" in capsys.readouterr().out
    assert main(["certify", "arm.toml", "hits.csv", "--json"]) == 4
    told = json.loads(capsys.readouterr().out)
    assert not told["certified"]
    assert told["undecided"] == []
    kinds = {(entry["kind"], *entry["names"]) for entry in told["violations"]}
    assert ("clearance", "roll", "ball") in kinds
    for entry in told["violations"]:
        assert 0.0 <= entry["from"] <= entry["to"] <= 4.0
        assert entry["value"] < entry["bound"]


def test_what_is_exported_is_certified(folder, capsys):
    assert main(["solve", "arm.toml"]) == 0
    assert main(["export", "arm.npz", "--to", "csv", "-o", "made.csv"]) == 0
    assert (folder / "made.csv").read_text().startswith("time [s],lift [rad],")
    assert main(["certify", "arm.toml", "made.csv"]) == 0
    assert "certified" in capsys.readouterr().out
    (folder / "made.csv").write_text((folder / "made.csv").read_text().replace("lift [rad]", "lit [rad]", 1))
    assert main(["certify", "arm.toml", "made.csv"]) == 2
    assert capsys.readouterr().err.count("expected") == 1
    (folder / "made.csv").write_text("time [s],turn [rad],roll [rad],d lift/dt [rad/s]\n0,0,0,0\n")
    assert main(["certify", "arm.toml", "made.csv"]) == 2
    assert 'no column "lift"' in capsys.readouterr().err


BROKEN = {
    "no file": (None, "a CSV file"),
    "empty": ("", "line 1: found nothing"),
    "no header": ("0,0,0,0\n1,0,0,0\n", "line 1"),
    "no rows": ("t,lift,turn,roll\n", "at least one row"),
    "no time": ("lift,turn,roll\n0,0,0\n", 'no column "t"'),
    "a joint less": ("t,lift,turn\n0,0,0\n", 'no column "roll"'),
    "a joint more": (GOOD.replace("roll", "roll,jaw").replace("\n", ",0\n").replace("jaw,0", "jaw"), '"jaw"'),
    "misspelt": (GOOD.replace("roll", "rol"), 'did you mean "roll"'),
    "twice": (GOOD.replace("roll", "lift"), "each column once"),
    "a cell less": (GOOD.replace("1,0.1,0,0", "1,0.1,0"), "line 3: found 3 cells"),
    "a cell more": (GOOD.replace("1,0.1,0,0", "1,0.1,0,0,0"), "line 3: found 5 cells"),
    "a word": (GOOD.replace("1,0.1,0,0", "1,up,0,0"), 'line 3, column turn: found "up"'),
    "an empty cell": (GOOD.replace("1,0.1,0,0", "1,,0,0"), "line 3, column turn"),
    "nan": (GOOD.replace("1,0.1,0,0", "1,nan,0,0"), "line 3, column turn"),
    "infinite": (GOOD.replace("1,0.1,0,0", "1,inf,0,0"), "line 3, column turn"),
    "huge": (GOOD.replace("1,0.1,0,0", "1,1e300,0,0"), "line 3, column turn"),
    "time in words": (GOOD.replace("1,0.1", "one,0.1"), "line 3, column t"),
    "time nan": (GOOD.replace("1,0.1", "nan,0.1"), "line 3, column t"),
    "negative time": (GOOD.replace("\n0,0,0,0", "\n-1,0,0,0"), "line 2, column t"),
    "time stands": (GOOD.replace("\n2,0.2", "\n1,0.2"), "line 4, column t"),
    "time goes back": (GOOD.replace("\n2,0.2", "\n0.5,0.2"), "after that of the row before"),
    "semicolons": (GOOD.replace(",", ";"), "line 1"),
    "tabs": (GOOD.replace(",", "\t"), "line 1"),
    "decimal commas": (GOOD.replace("0.1", "0,1"), "cells"),
    "not text": (b"\xff\xfe\x00t", "text in UTF-8"),
    "a null byte": (b"t,lift,turn,roll\n0,0\x00,0,0\n", "line 2"),
    "an open quote": (GOOD.replace("1,0.1", '1,"0.1'), ""),
    "a comment": ("# a plan\n" + GOOD, "line 1"),
    "units": (GOOD.replace("lift", "lift [deg]"), 'did you mean "lift"'),
    "degrees beyond": (GOOD.replace("0.2,0,0.1", "0.2,0,1e7"), "line 4, column roll"),
    "a folder": ("folder", "a CSV file"),
}


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_file_is_refused_with_a_clear_message(what, folder, capsys):
    text, said = BROKEN[what]
    file = folder / "plan.csv"
    if text == "folder":
        file.mkdir()
    elif isinstance(text, bytes):
        file.write_bytes(text)
    elif text is not None:
        file.write_text(text)
    assert main(["certify", "arm.toml", "plan.csv"]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert "Traceback" not in err
    assert re.search(r"plan\.csv: ", err)
    assert "expected" in err


def test_there_are_thirty_kinds_of_them():
    assert len(BROKEN) >= 30


@pytest.mark.parametrize(
    ("times", "joints", "said"),
    [
        ([0.0, 1.0], [[0.0] * 3], "joints: found an array of shape (1, 3)"),
        ([0.0], [[0.0] * 2], "(1, 3)"),
        ([], [], "at least one"),
        ([1.0, 0.5], [[0.0] * 3] * 2, "times[1]"),
        ([-1.0], [[0.0] * 3], "times[0]"),
        ([0.0], [[0.0, float("nan"), 0.0]], "joints[0, 1]"),
        ("now", [[0.0] * 3], "times: found"),
    ],
)
def test_arrays_that_are_no_trajectory_are_refused(times, joints, said, folder):
    with pytest.raises(vq.ProblemError) as raised:
        vq.certify(vq.load_problem("arm.toml"), times, joints)
    assert said in str(raised.value)


@pytest.mark.property
@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 10**6))
def test_a_bound_holds_at_every_instant(seed):
    rng = np.random.default_rng(seed)
    joints = arm(rng)
    entry = obstacle(rng, int(rng.integers(3)))
    problem = problem_of(joints, [entry])
    rows = rng.uniform(-0.8, 0.8, (2, JOINTS))
    verdict = vq.certify(problem, [0.0, 1.0], rows)
    q = rows[0] + np.linspace(0.0, 1.0, 300)[:, None] * (rows[1] - rows[0])
    ends = links(Certifier(problem).arm, q)
    points = np.concatenate([ends[:, :, 0].reshape(-1, 3), ends[:, :, 1].reshape(-1, 3)])
    assert max(float(apart(points, entry).min()), 0.0) - 0.04 >= verdict.clearance - 1e-9
