"""Members that end in offset joints, eqs. (12)-(21): their ends, their clearance rows and proofs, their maneuvers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arms import TRUSSES, arm_problem, central_differences, random_pose

import vgtm_qp as vq
from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.arm.truss.kinematics import EndKinematics
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.separation import Separation
from vgtm_qp.study.scenes import random_scene


@pytest.mark.parametrize("name", TRUSSES)
def test_the_jacobians_of_ends_are_those_of_the_formulas(name, rng):
    truss = TRUSSES[name](joint_offset=0.1)
    X = random_pose(truss, rng)
    kinematics = EndKinematics(truss.members, truss.joints)
    kinematics.evaluate(X)
    wanted = central_differences(truss.member_ends, X)
    found = np.zeros_like(wanted)
    for member, end, corner in np.ndindex(*kinematics.nodes.shape):
        node = kinematics.nodes[member, end, corner]
        found[member, end, :, node] += kinematics.jacobian[member, end, :, 3 * corner : 3 * corner + 3]
    np.testing.assert_allclose(found, wanted, atol=1e-8)


def beside_a_cube(joint_offset=0.1, **more):
    return arm_problem(
        (0.6, 0.1, 2.9),
        bays=4,
        truss={"joint_offset": joint_offset, **more},
        obstacle=[{"name": "cube", "shape": "box", "center": [0.95, 0.1, 2.0], "size": 0.5}],
        clearance={"safe": 0.05, "influence": 0.4},
    )


def separation_of(setup):
    return Separation(replace(setup, margin=0.0))


def test_clearance_rows_are_the_derivatives_of_the_distances(rng):
    """Distances by their definition at moved nodes, against the rows: the joints' rotation is part of both."""
    setup = build_arm(beside_a_cube())
    truss, monitor = truss_of(setup.arm), setup.monitor
    X = truss.home + 0.02 * rng.normal(size=truss.home.shape)
    rows = separation_of(setup).rows(X, 0.0, 0.0, 1.0, {}, 0.0)
    assert rows.nodes.shape[1] == 12
    step = rng.normal(size=X.shape)
    h, names = 1e-6, [rows.name(k) for k in range(len(rows))]
    change = np.einsum("rsc,rsc->r", rows.coefficients, step[rows.nodes])

    def distances(Y):
        pairs = monitor.near(setup.arm.points(Y), 0.0, 0.6)
        found = {}
        for k in range(len(pairs)):
            found[pairs.name(k)] = min(found.get(pairs.name(k), np.inf), float(pairs.distance[k]))
        return found

    ahead, behind = distances(X + h * step), distances(X - h * step)
    single = [k for k, name in enumerate(names) if names.count(name) == 1]
    assert sum("cube" in names[k] for k in single) >= 3
    for k in single:
        wanted = (ahead[names[k]] - behind[names[k]]) / (2 * h)
        assert change[k] == pytest.approx(wanted, abs=1e-5), names[k]


def test_rows_of_different_widths_join(rng):
    narrow = ClearanceRows(np.array([[0, 1, 2, 3]]), np.ones((1, 4, 3)), np.zeros(1))
    wide = ClearanceRows(np.arange(12)[None], 2.0 * np.ones((1, 12, 3)), np.ones(1))
    moved = rng.normal(size=(12, 3))
    for first, second in ((narrow, wide), (wide, narrow)):
        joined = first.joined(second)
        value = np.einsum("rsc,rsc->r", joined.coefficients, moved[joined.nodes])
        alone = [np.einsum("rsc,rsc->r", r.coefficients, moved[r.nodes])[0] for r in (first, second)]
        np.testing.assert_allclose(value, alone)
        assert list(joined.lower) == [first.lower[0], second.lower[0]]


def test_a_proof_of_the_way_holds_at_every_instant_of_it(rng):
    setup = build_arm(beside_a_cube())
    separation, truss, monitor = separation_of(setup), truss_of(setup.arm), setup.monitor
    certified = 0
    for _ in range(12):
        start, end = (truss.home + 0.05 * rng.normal(size=truss.home.shape) for _ in range(2))
        end = start + 0.5 * (end - start)
        least = min(
            setup.least_clearance(start + s * (end - start), 0.0, among="obstacles")
            for s in np.linspace(0, 1, 41)
        )
        report = separation.between(start, end, 0.0, 0.0, {})
        if report.certified:
            certified += 1
            assert least >= setup.safe - 5e-5 - 1e-9
        else:
            assert least < setup.safe + 1e-3 or not monitor.keeps(
                setup.arm.points(end), 0.0, 0.0, setup.self_safe
            )
            assert np.all((report.fraction >= 0.0) & (report.fraction <= 1.0))
    assert certified > 0


@pytest.mark.parametrize(
    ("module", "bays", "offset"),
    [
        ("octahedral", 4, 0.1),
        ("double-octahedral", 2, 0.05),
        ("hexapod", 3, 0.1),
        ("longeron", 4, 0.1),
        ("tetrahedral", 3, 0.1),
    ],
)
def test_maneuvers_with_offset_joints_are_certified(module, bays, offset, monkeypatch):
    monkeypatch.setenv("VGTM_CC", "none")
    problem = arm_problem(bays=bays, truss={"module": module, "stroke": None, "joint_offset": offset})
    home = truss_of(build_arm(problem).arm)
    tip = home.tip_weights @ home.home[home.tip]
    goal = (tip + np.array([0.12, 0.04, -0.05]) * home.height).tolist()
    side = [tip[0] + 0.42 + 0.25 + 0.06 + 0.577 - 0.15, 0.0, 0.5 * home.height]
    problem = problem.replace(
        {
            "maneuver.waypoint": [{"time": 5.0, "position": goal}],
            "maneuver.steps": 6,
            "obstacle": [{"name": "cube", "shape": "box", "center": side, "size": 0.5}],
        }
    )
    maneuver = vq.solve(problem)
    assert maneuver.status == "solved", maneuver.manifest["blocked_by"]
    assert maneuver.certificate.ok, maneuver.certificate.failures()


def test_a_state_keeps_the_whole_distance_whatever_the_way_there_was_allowed():
    """Between states the members of offset joints may come 5e-5 m nearer; a state once took that as its own leave."""
    problem = random_scene(1991, 622, steps=30).problem.replace({"method.retries": False})
    assert problem.truss.joint_offset > 0.0
    certificate = vq.solve(problem).certificate
    assert certificate.clearance.value < 0.081
    assert certificate.ok, str(certificate)
