"""Other packages on the same arm: their models are those of the problem, and their steps do what is asked."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import vgtm_qp as vq
from vgtm_qp.bench.between import least_by_resolver, least_by_walker
from vgtm_qp.bench.contestants import make_baseline
from vgtm_qp.bench.peers import JointScene, MinkStep, PinkStep, mjcf
from vgtm_qp.bench.scenes import make_scenes
from vgtm_qp.bench.tour import Goal, make_goals

PEERS = {"mink": MinkStep, "pink": PinkStep}


@pytest.fixture(scope="module")
def problem() -> vq.Problem:
    """The arm of seven joints; its cube lies askew, so that no rotation may be left out."""
    cube = {"name": "cube", "shape": "box", "center": [0.35, 0.36, 0.88], "size": [0.2, 0.25, 0.3]}
    cube["rotation_vector"] = [0.2, -0.1, 0.3]
    return make_scenes(("serial",))[0].problem.replace({"obstacle": [cube]})


def some_joints(count: int) -> np.ndarray:
    return np.random.default_rng(20).uniform(-1.2, 1.2, (count, 7))


def places(scene: JointScene, q: np.ndarray) -> np.ndarray:
    """The base, the joints' origins and the tip, (9, 3), by the package's own kinematics."""
    return scene.arm.chain.at(np.append(q, np.zeros(6)))[0][:9]


def exact_distances(scene: JointScene, q: np.ndarray) -> list[float]:
    """The distances of all pairs in ascending order, m, by closed forms; a pair may have two contacts."""
    points = scene.arm.points(np.append(q, np.zeros(6)))
    found = scene.setup.monitor.near(points, 0.0, 10.0, self_reach=10.0)
    least: dict[tuple[int, ...], float] = {}
    for pair, apart in zip(
        zip(found.body, found.other, found.is_self, strict=True), found.distance, strict=True
    ):
        least[pair] = min(apart, least.get(pair, np.inf))
    return sorted(least.values())


def test_the_model_for_mujoco_has_the_arm_s_joints_links_and_boxes(problem: vq.Problem) -> None:
    mujoco = pytest.importorskip("mujoco")
    scene = JointScene.of(problem)
    model = mujoco.MjModel.from_xml_string(mjcf(scene))
    data = mujoco.MjData(model)
    assert model.jnt_range == pytest.approx(scene.arm.stroke)
    assert scene.pairs == [(0, 2)]
    fromto = np.zeros(6)
    for q in some_joints(10):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        nodes = places(scene, q)
        assert data.site("tip").xpos == pytest.approx(nodes[8], abs=1e-12)
        for j, name in enumerate(scene.arm.quantity_names):
            assert data.body(name).xpos == pytest.approx(nodes[1 + j], abs=1e-12)
        geoms = [model.geom(f"link {k}").id for k in range(3)]
        cube = model.geom("cube 0").id
        found = [mujoco.mj_geomDistance(model, data, geom, cube, 10.0, fromto) for geom in geoms]
        found.append(mujoco.mj_geomDistance(model, data, geoms[0], geoms[2], 10.0, fromto))
        # Of bodies that overlap, one measures the way out and the other the axis.
        assert np.maximum(sorted(found), 0.0) == pytest.approx(
            np.maximum(exact_distances(scene, q), 0.0), abs=1e-5
        )


@pytest.mark.parametrize("name", list(PEERS))
def test_a_peer_that_is_not_installed_says_what_to_install(
    problem: vq.Problem, name: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(vq.SolverError, match=rf"{name} is not installed: pip install"):
        make_baseline(name, problem, 7)


@pytest.mark.parametrize("name", list(PEERS))
def test_a_peer_is_not_tried_on_what_its_model_lacks(problem: vq.Problem, name: Any) -> None:
    truss = make_scenes(("free",))[0]
    with pytest.raises(vq.SolverError, match="serial arms"):
        make_baseline(name, truss.problem, truss.bays)
    ball = {"name": "ball", "shape": "sphere", "center": [0.35, 0.36, 0.88], "radius": 0.1}
    with pytest.raises(vq.SolverError, match="boxes"):
        make_baseline(name, problem.replace({"obstacle": [ball]}), 7)


@pytest.mark.parametrize("name", list(PEERS))
def test_a_peer_stands_where_it_is_placed_and_reaches_goals_within_its_limits(
    problem: vq.Problem, name: Any
) -> None:
    pytest.importorskip(name)
    scene, resolver = JointScene.of(problem), vq.Resolver(problem)
    peer = PEERS[name](problem)
    for q in some_joints(5):
        peer.place(replace(resolver.state, quantities=q))
        assert peer.tip == pytest.approx(places(scene, q)[8], abs=1e-12)
    peer.place(resolver.state)
    q = resolver.state.quantities
    for goal in make_goals(problem, resolver)[1:]:
        assert peer.step(goal)
        # One linearised step of 15 mm, with a slight pull to the home pose.
        assert np.linalg.norm(peer.tip - goal.pose.position) < 5e-3
        assert np.all(np.abs(peer.reached - q) <= scene.arm.rate * scene.setup.dt + 1e-9)
        assert np.all((peer.reached >= scene.arm.stroke[:, 0]) & (peer.reached <= scene.arm.stroke[:, 1]))
        q = peer.reached


def test_what_comes_near_between_steps_counts(problem: vq.Problem) -> None:
    resolver = vq.Resolver(problem)
    setup, goals = resolver.setup, make_goals(problem, resolver)
    home = setup.arm.home_configuration

    class Sweeping:
        """Turns its first joint beyond the cube in one step, and back in the next."""

        turn = 0.0

        @property
        def configuration(self) -> np.ndarray:
            return home + self.turn * np.eye(len(home))[0]

        def place(self, state: vq.State) -> None:
            self.turn = 0.0

        def step(self, goal: Goal) -> bool:
            self.turn = 1.6 - self.turn
            return True

    def least_at(q: np.ndarray) -> float:
        return float(setup.monitor.least(setup.arm.points(q), among="obstacles")[0])

    found = least_by_walker(setup, goals[:3], Sweeping())
    ends = [least_at(home), least_at(home + 1.6 * np.eye(len(home))[0])]
    between = [least_at(home + turn * np.eye(len(home))[0]) for turn in np.linspace(0.0, 1.6, 21)]
    assert found == pytest.approx(min(between), abs=1e-9)
    assert found < min(ends) - 0.03
    assert least_by_resolver(resolver, goals) >= setup.safe - 1e-9


@pytest.mark.parametrize("name", list(PEERS))
def test_a_peer_keeps_from_the_cube_that_it_would_come_near(problem: vq.Problem, name: Any) -> None:
    pytest.importorskip(name)
    scene, resolver = JointScene.of(problem), vq.Resolver(problem)
    least = []
    for each in (problem.replace({"obstacle": []}), problem):
        peer = PEERS[name](each)
        peer.place(resolver.state)
        nearest = np.inf
        for goal in make_goals(problem, resolver)[1:]:
            peer.step(goal)
            nearest = min(nearest, exact_distances(scene, peer.reached)[0])
        least.append(nearest)
    # Its rows are linear, so that it may come nearer than asked by a few millimetres.
    assert least[0] < scene.setup.safe - 0.01 < least[1]
