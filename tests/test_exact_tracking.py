"""Tracking as an equality: the curve ends in the tip, stations keep to it where they can, and give way where not."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
from arms import arm_problem
from hypothesis import given, settings
from hypothesis import strategies as st

import vgtm_qp as vq
from vgtm_qp import Resolver
from vgtm_qp.curve.curve import Curve
from vgtm_qp.curve.families import make_family
from vgtm_qp.errors import ProblemError, ResultError
from vgtm_qp.maneuver.retries import DeadEnd, retries
from vgtm_qp.step.stops import Stop, StopKind
from vgtm_qp.study.scenes import random_scene
from vgtm_qp.verify.curve import RecordedCurve

MODES = ("exact", "hard", "elastic")


@pytest.fixture(autouse=True)
def _without_a_compiler(monkeypatch):
    monkeypatch.setenv("VGTM_CC", "none")


def gaps(resolver):
    """(K,) distances of the stations from their curve nodes."""
    layout, state = resolver.setup.layout, resolver.state
    stations = layout.arm.stations.centres(state.nodes)[layout.tracked]
    return np.linalg.norm(stations - layout.curve_weights @ state.control_vertices, axis=1)


@pytest.mark.smoke
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("module", "bays", "track"),
    [
        ("octahedral", 5, "position"),
        ("octahedral", 7, "pointing"),
        ("hexapod", 4, "pointing"),
        ("longeron", 6, "orientation"),
        ("tetrahedral", 4, "position"),
        ("octahedral", 12, "pointing"),
    ],
)
def test_the_curve_begins_at_the_base_and_ends_in_the_end_effector(module, bays, track, mode):
    turned = {"pointing": {"pointing": [0, 0, 1]}, "orientation": {"rotation_vector": [0, 0, 0]}}.get(track)
    problem = arm_problem(
        bays=bays,
        truss={"module": module, "stroke": None},
        curve={"control_vertices": 5, "torsion_vertices": int(track == "orientation")},
        end_effector={"track": ["position", track] if turned else ["position"]},
        method={"tracking_mode": mode},
        target=(0.3, -0.2, 0.7 * bays),
        waypoint=turned,
    )
    resolver = vq.Resolver(problem)
    start = resolver.tip()[0]
    for share in np.linspace(0.05, 0.2, 4):
        goal = start + share * (np.array([0.5, -0.3, 0.8 * start[2]]) - start)
        step = resolver.step(position=goal)
        assert step.moved
        p, (position, rotation) = resolver.state.control_vertices, resolver.tip()
        np.testing.assert_allclose(p[0], 0.0, atol=1e-12)
        np.testing.assert_allclose((p[1] - p[0])[:2], 0.0, atol=1e-12)
        assert (p[1] - p[0])[2] > 0.0
        np.testing.assert_allclose(p[-1], position, atol=1e-12)
        if turned:
            last = p[-1] - p[-2]
            np.testing.assert_allclose(last / np.linalg.norm(last), rotation[:, 2], atol=1e-9)
        if mode == "hard" or (mode == "exact" and not step.gave_way):
            assert gaps(resolver).max() < 1e-6


@pytest.mark.parametrize("mode", MODES)
def test_rows_of_the_curve_end_are_equalities_of_every_qp(mode):
    problem = vq.load_problem("five_bay_two_cubes_pointing").replace({"method.tracking_mode": mode})
    qp = vq.Resolver(problem).build(position=[0.05, 0.0, 4.0])
    names = [label.name for label in qp.columns]
    held = ["gap: face 5 x", "gap: face 5 y", "gap: face 5 z", "tilt: face 5 x", "tilt: face 5 y"]
    other = "gap: face 3 x"
    for name in [*held, *([] if mode == "elastic" else [other])]:
        k = names.index(name)
        assert qp.column_lower[k] == qp.column_upper[k] == 0.0, name
    if mode == "elastic":
        assert not np.isfinite(qp.column_upper[names.index(other)])
    assert {label.kind for label in qp.rows} >= {"curve leg", "curve base", "tracking"}


def test_stations_give_way_where_they_must_and_come_back():
    problem = random_scene(1991, 78).problem.replace({"method.retries": False})
    gave: list[bool] = []
    exact = vq.solve(problem, progress=lambda _, step: gave.append(step.gave_way))
    assert exact.status == "solved"
    assert 0 < sum(gave) < 5
    assert not gave[-1]
    certificate = exact.certificate
    assert certificate.ok
    assert 0.0 < certificate.states_off_curve.value <= sum(gave) / len(gave)
    assert certificate.tracking_gap.value > 1e-4
    assert certificate.curve_end_gap.value < 1e-9
    hard = vq.solve(problem.replace({"method.tracking_mode": "hard"}))
    assert hard.certificate.ok
    assert hard.certificate.states_off_curve.value == 0.0


def test_stations_stay_on_the_curve_where_leaving_it_gets_the_arm_no_further():
    problem = vq.load_problem("snake_past_a_cube").replace({"method.retries": False})
    exact = vq.solve(problem)
    assert exact.status == "solved"
    # One piece of path does not converge on it.
    assert exact.certificate.states_off_curve.value < 0.03


@pytest.mark.dear
@pytest.mark.parametrize("mode", ["exact", "elastic"])
def test_the_curve_never_ends_against_the_direction_of_the_tip(mode):
    """Its last leg used to shrink from step to step where the arm crept into a dead end, and then reversed."""
    problem = vq.load_problem("five_bay_two_cubes_pointing").replace({"method.tracking_mode": mode})
    resolver = Resolver(problem)
    home, goal = resolver.tip()[0], np.array(problem.maneuver.waypoint[-1].position)
    way = (goal - home) / np.linalg.norm(goal - home)
    for _ in range(130):
        ahead = min(float((resolver.tip()[0] - home) @ way) + 0.02, float(np.linalg.norm(goal - home)))
        step = resolver.step(position=home + ahead * way, pointing=[0.0, 0.0, 1.0], dt=0.1)
        p, z = resolver.state.control_vertices, resolver.tip()[1][:, 2]
        assert (p[-1] - p[-2]) @ z > 0.999 * np.linalg.norm(p[-1] - p[-2]) > 0.0
        assert p[1, 2] > p[0, 2]
        if not step.moved:
            break


def as_graph(problem, tip):
    """The truss of a problem as nodes and members; `tip` are places among the nodes of its last face."""
    truss, table = vq.build_truss(problem.truss), problem.to_dict()
    names, faces = truss.node_names, [[truss.node_names[n] for n in face] for face in truss.faces]
    table["truss"] = {
        "module": "graph",
        "tip": [faces[-1][k] for k in tip],
        "faces": faces,
        "node": [
            {"name": name, "position": place.tolist(), "fixed": bool(is_base)}
            for name, place, is_base in zip(names, truss.home, truss.base, strict=True)
        ],
        "member": [
            {"name": name, "nodes": [names[n] for n in nodes], "actuated": bool(moves)}
            | ({"stroke": stroke.tolist()} if moves else {})
            for name, nodes, moves, stroke in zip(
                truss.member_names, truss.members, truss.actuated, truss.stroke, strict=True
            )
        ],
    }
    return vq.Problem.from_dict(table)


@pytest.mark.parametrize("track", ["position", "pointing"])
def test_the_tip_of_a_graph_may_name_the_nodes_of_its_last_face_in_any_order(track):
    problem = arm_problem(
        (0.2, 0.1, 2.4),
        bays=3,
        steps=4,
        waypoint={"pointing": [0.0, 0.0, 1.0] if track == "pointing" else None},
        curve={"control_vertices": 4},
        end_effector={"track": sorted({"position", track}, reverse=True)},
    )
    found = [vq.solve(as_graph(problem, tip)) for tip in ((0, 1, 2), (2, 1, 0), (1, 2, 0))]
    for maneuver in found:
        assert maneuver.certificate.ok, maneuver.certificate.failures()
        assert maneuver.certificate.curve_end_gap.value < 1e-9
        assert (maneuver.certificate.curve_end_angle.value is not None) == (track == "pointing")
        np.testing.assert_allclose(maneuver.nodes, found[0].nodes, atol=1e-7)


def test_an_arm_that_cannot_hold_its_stations_tracks_elastically_and_says_so_where_it_is_asked_to():
    problem = vq.load_problem("five_bay_free").replace({"method.hard_coordinates": ["position", "pointing"]})
    with pytest.raises(ProblemError, match=r"hard_coordinates.*cannot keep pointing"):
        vq.Resolver(problem)
    assert not vq.Resolver(problem.replace({"method.tracking_mode": "elastic"})).setup.layout.hard_tracking


def test_a_curve_that_is_not_where_the_file_says_is_found():
    maneuver = vq.solve(arm_problem(bays=3, steps=4, curve={"control_vertices": 5}, target=(0.2, 0.1, 2.4)))
    assert maneuver.certificate.ok
    moved = maneuver.control_vertices.copy()
    moved[2, -1] += [0.0, 1e-3, 0.0]
    found = vq.verify(replace(maneuver, control_vertices=moved))
    assert found.curve_end_gap.value == pytest.approx(1e-3, rel=1e-6)
    assert found.curve_end_gap.where == "row 2"
    assert not found.ok
    record = {**maneuver.manifest["curve"], "stations": [[0, 1, 999]] * 3}
    with pytest.raises(ResultError, match=r"manifest\.curve\.stations"):
        vq.verify(replace(maneuver, manifest={**maneuver.manifest, "curve": record}))
    without = {key: value for key, value in maneuver.manifest.items() if key != "curve"}
    assert vq.verify(replace(maneuver, manifest=without)).tracking_gap.value is None


@settings(max_examples=30, deadline=None)
@given(
    family=st.sampled_from(["bezier", "b-spline", "beta-spline"]),
    seed=st.integers(0, 2**31),
    vertices=st.integers(4, 9),
    by_arc_length=st.booleans(),
)
def test_curve_nodes_of_the_certificate_are_those_of_the_curve(family, seed, vertices, by_arc_length):
    rng = np.random.default_rng(seed)
    options = {"bias": 1.3, "tension": 2.0} if family == "beta-spline" else {}
    made = make_family(family, vertices, **options)
    p = np.linspace(0.0, 1.0, vertices)[:, None] * [0.3, 0.2, 4.0] + 0.1 * rng.normal(size=(vertices, 3))
    curve, nodes = Curve(made, p), np.sort(rng.uniform(0.0, 1.0, 5))
    s = curve.arc_parameter(nodes) if by_arc_length else nodes
    recorded = RecordedCurve(
        made.breaks, made.extraction, nodes, by_arc_length, np.zeros((5, 1), int), np.ones((5, 1))
    )
    np.testing.assert_allclose(recorded.points(p[None])[0], curve.position(s), atol=1e-7)
    end = recorded.end_direction(p[None])[0]
    np.testing.assert_allclose(end / np.linalg.norm(end), curve.tangent(1.0), atol=1e-12)


def test_stations_that_gave_way_come_back_within_a_few_steps():
    """With the weights of elastic tracking none of them would: the next equality has to close the whole gap at once."""
    problem = vq.load_problem("five_bay_two_cubes_pointing").replace({"method.retries": False})
    resolver = vq.Resolver(problem)
    home, goal = resolver.tip()[0], np.array(problem.maneuver.waypoint[-1].position)

    def go(to, steps):
        for _ in range(steps):
            away = to - resolver.tip()[0]
            step = resolver.step(position=resolver.tip()[0] + away * min(1.0, 0.05 / np.linalg.norm(away)))
            assert not step.moved or step.gap == pytest.approx(gaps(resolver).max(), abs=1e-12)
            yield step.gave_way

    assert sum(go(goal, 30)) > 10
    assert not any(list(go(home, 15))[8:])
    assert gaps(resolver).max() < 1e-6


def test_a_curve_by_arc_length_stays_near_the_arm_where_it_gives_way():
    """So great a weight on the whole gap would throw the curve metres away: its rows are linear near the gap alone."""
    problem = vq.load_problem("beta_spline_past_a_cube").replace(
        {"maneuver.waypoint": [{"time": 10.0, "position": [1.17, 0.3, 1.95]}], "method.retries": False}
    )
    maneuver = vq.solve(problem)
    assert maneuver.certificate.ok
    assert 1e-3 < maneuver.certificate.tracking_gap.value < 0.6
    assert np.abs(maneuver.control_vertices).max() < 5.0


def test_an_arm_with_limited_accelerations_leaves_its_curve_only_where_that_takes_more_than_half():
    problem = vq.load_problem("five_bay_two_cubes_pointing").replace({"truss.acceleration": 0.3})
    exact, hard = vq.Resolver(problem), vq.Resolver(problem.replace({"method.tracking_mode": "hard"}))
    left, goal = 0, np.array([1.15, 0.0, 2.2])
    for _ in range(20):
        hard.state = exact.state
        away = goal - exact.tip()[0]
        asked = {"position": exact.tip()[0] + 0.2 * away / np.linalg.norm(away)}
        step = exact.step(**asked)
        if step.gave_way and not step.braked:
            left += 1
            assert hard.step(**asked).progress < 0.5 * (1.0 + 1e-9)
    assert left > 0


def test_a_step_counts_all_its_qps_and_a_blocked_one_says_where_stations_are():
    problem = vq.load_problem("five_bay_blocked_by_wall").replace({"end_effector.mode": "hard"})
    resolver, steps = vq.Resolver(problem), []
    goal = np.array(problem.maneuver.waypoint[-1].position)
    for _ in range(60):
        away = goal - resolver.tip()[0]
        steps.append(resolver.step(position=resolver.tip()[0] + 0.08 * away / np.linalg.norm(away)))
        assert steps[-1].gap == pytest.approx(gaps(resolver).max(), abs=1e-12)
        if not steps[-1].moved:
            break
    assert steps[-1].status == "blocked"
    assert steps[-1].gave_way == (steps[-1].gap > 1e-7)
    # On the curve, and off it.
    assert steps[-1].qps >= 2
    assert steps[0].qps == 1


def test_no_retry_lets_hard_tracking_give_way():
    """Elastic tracking reaches the end of this path; hard tracking does not, whatever else is tried."""
    problem = vq.load_problem("five_bay_two_cubes_pointing").replace(
        {"method.tracking_mode": "hard", "maneuver.steps": 10}
    )
    first = vq.solve(problem.replace({"method.retries": False}))
    assert first.status == "blocked"
    vertices = first.control_vertices[-1]
    stop = Stop(StopKind.OBSTACLE)
    modes = [p.method.tracking_mode for _, p in retries(problem, DeadEnd(stop, vertices, 4.0, np.eye(3)[0]))]
    assert len(modes) > 5
    assert set(modes) == {"hard"}
    exact = problem.replace({"method.tracking_mode": "exact"})
    names = [name for name, _ in retries(exact, DeadEnd(stop, vertices, 4.0, np.eye(3)[0]))]
    assert names == ["more control vertices", "elastic tracking"]


def test_braking_steps_say_whether_stations_are_off_the_curve():
    problem = vq.load_problem("five_bay_two_cubes_pointing").replace({"truss.acceleration": 0.3})
    off = []
    for count in (2, 14):
        resolver = Resolver(problem)
        for _ in range(count):
            away = np.array([1.15, 0.0, 2.2]) - resolver.tip()[0]
            resolver.step(position=resolver.tip()[0] + 0.2 * away / np.linalg.norm(away))
        while (step := resolver.brake()) is not None:
            assert step.braked
            off.append(bool(gaps(resolver).max() > 1e-6))
            assert step.gave_way == off[-1]
    assert True in off
    assert False in off


@pytest.fixture(scope="module")
def hard_result():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VGTM_CC", "none")
        problem = vq.load_problem("five_bay_two_cubes_pointing")
        return vq.solve(
            problem.replace({"method.tracking_mode": "hard", "method.retries": False, "maneuver.steps": 10})
        )


@pytest.mark.parametrize(
    ("vertex", "name"), [(0, "curve_start_gap"), (1, "curve_start_angle"), (-1, "curve_end_gap")]
)
def test_a_certificate_holds_both_ends_of_the_curve(hard_result, vertex, name):
    assert getattr(hard_result.certificate, name).value < 1e-9
    vertices = hard_result.control_vertices.copy()
    vertices[2:, vertex, 0] += 0.1
    found = getattr(vq.verify(replace(hard_result, control_vertices=vertices)), name)
    assert not found.ok
    assert found.value > 0.05


def test_a_certificate_measures_the_turns_that_are_kept_along_the_curve():
    both = {"method.hard_coordinates": ["position", "pointing"]}
    kept = vq.solve(vq.load_problem("hexapod_past_a_cube").replace(both))
    assert kept.certificate.tracking_angle.value < 1e-8
    problem = vq.load_problem("longeron_past_a_cube").replace(
        {
            **both,
            "method.retries": False,
            "maneuver.waypoint": [{"time": 10.0, "position": [1.35, 0.0, 2.3]}],
        }
    )
    gave: list[float] = []
    left = vq.solve(problem, progress=lambda _, step: gave.append(step.gap))
    measure = left.certificate.tracking_angle
    assert 1e-3 < measure.value < 0.1
    assert measure.bound is None
    # Step.gap is the sine of each tilt times the mean length of members.
    assert max(gave) == pytest.approx(measure.value, rel=0.3)


def last_station_alone(curve):
    curve.update({key: curve[key][-1:] for key in ("nodes", "stations", "weights")})


def shrunk(name):
    return lambda curve: curve.update({name: (0.5 * np.array(curve[name])).tolist()})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict.clear, None),
        (last_station_alone, "has 1 stations; this truss has 5"),
        (shrunk("extraction"), "extraction are not those of means"),
        (shrunk("weights"), "weights are not those of means"),
        (shrunk("nodes"), "nodes do not increase to 1"),
        (shrunk("breaks"), "breaks do not increase to 1"),
        (lambda curve: curve["stations"].reverse(), "do not end with the end effector"),
        (lambda curve: curve.update(ends_at_tip=False), "ends_at_tip is false"),
        (lambda curve: curve.update(ends_along_tip=False), "ends_along_tip is false"),
    ],
)
def test_a_certificate_refuses_a_curve_that_is_not_that_of_the_problem(hard_result, change, message):
    assert hard_result.certificate.ok
    curve = copy.deepcopy(hard_result.manifest["curve"])
    change(curve)
    changed = replace(hard_result, manifest={**hard_result.manifest, "curve": curve or None})
    certificate = vq.verify(changed)
    assert not certificate.ok
    assert any((message or "manifest.curve is missing") in line for line in certificate.contradictions)


@pytest.mark.parametrize("tracking", ["coupled", "recursive", "parallel"])
def test_a_certificate_bounds_the_gaps_of_every_method_that_keeps_stations_on_the_curve(
    hard_result, tracking
):
    problem = copy.deepcopy(hard_result.manifest["problem"])
    problem["method"].update(tracking=tracking, tracking_mode="hard" if tracking == "coupled" else "exact")
    curve = {**hard_result.manifest["curve"], "held": False}
    vertices = hard_result.control_vertices.copy()
    vertices[3:, 2] += 1e-3
    manifest = {**hard_result.manifest, "problem": problem, "curve": curve}
    gap = vq.verify(replace(hard_result, manifest=manifest, control_vertices=vertices)).tracking_gap
    assert gap.bound == 1e-6
    assert gap.value > 1e-4
    assert not gap.ok


def test_an_arm_too_short_to_keep_a_station_on_the_curve_is_moved_elastically_or_refused():
    short = vq.load_problem("longeron_past_a_cube").replace({"truss.bays": 1, "obstacle": []})
    resolver = Resolver(short)
    assert not resolver.setup.layout.hard_tracking
    assert resolver.step(position=resolver.tip()[0] + [0.01, 0.0, -0.01]).status == "reached"
    for key, value in (("tracking_mode", "hard"), ("tracking", "recursive"), ("tracking", "parallel")):
        with pytest.raises(ProblemError, match=f'method.{key}: found "{value}".*so short an arm'):
            Resolver(short.replace({f"method.{key}": value}))


@pytest.mark.parametrize("tracking", ["recursive", "parallel"])
def test_an_arm_without_faces_is_not_moved_along_them(tracking):
    problem = vq.load_problem("tetrahedral_truss_circle")
    assert not problem.truss.faces
    with pytest.raises(
        ProblemError, match=f'method.tracking: found "{tracking}".*this arm has fewer than two'
    ):
        Resolver(problem.replace({"method": {"name": "qp", "tracking": tracking}}))


@pytest.mark.dear
def test_where_exact_tracking_is_stuck_its_ways_out_are_those_of_elastic_tracking():
    problem = random_scene(1991, 241, steps=30).problem
    exact, elastic = (
        vq.solve(problem.replace({"method.tracking_mode": mode})) for mode in ("exact", "elastic")
    )
    assert exact.status == elastic.status == "solved"
    assert exact.manifest["way_out"] == elastic.manifest["way_out"] != ""
    np.testing.assert_array_equal(exact.nodes, elastic.nodes)


def test_joints_in_one_place_may_both_be_stations():
    joints = [
        {"name": f"joint {k}", "axis": axis, "position": [0.0, 0.0, z], "home": 0.3, "limits": [-2.0, 2.0]}
        for k, (axis, z) in enumerate(
            [([1, 0, 0], 0.0), ([0, 1, 0], 0.4), ([1, 0, 0], 0.0), ([0, 1, 0], 0.4), ([1, 0, 0], 0.4)]
        )
    ]
    data = {
        "name": "joints in one place",
        "arm": {"joint": joints, "tip": [0.0, 0.0, 0.4], "every": 1},
        "curve": {"family": "bezier", "control_vertices": 5},
        "method": {"tracking_mode": "elastic", "retries": False},
        "end_effector": {"track": ["position"]},
        "maneuver": {"steps": 4, "waypoint": [{"time": 4.0, "position": [0.0, 0.0, 1.0]}]},
        "clearance": {"safe": 0.01, "influence": 0.2},
    }
    start = vq.Resolver(vq.Problem.from_dict(data)).tip()[0]
    data["maneuver"]["waypoint"][0]["position"] = np.add(start, [0.05, 0.03, -0.05]).tolist()
    maneuver = vq.solve(vq.Problem.from_dict(data))
    nodes = maneuver.manifest["curve"]["nodes"]
    assert np.min(np.diff(nodes)) == 0.0
    assert maneuver.status == "solved"
    assert maneuver.certificate.ok, maneuver.certificate.contradictions
