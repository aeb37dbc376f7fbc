"""The steps of long arms by C against the same steps by NumPy."""

from __future__ import annotations

from dataclasses import replace

import modules
import numpy as np
import pytest
from arms import make_layout
from steps import make_step

from vgtm_qp.arm.truss.build import lock_members
from vgtm_qp.bench.scenes import make_scenes
from vgtm_qp.bench.tour import Tour, make_goals
from vgtm_qp.compiled import compiler
from vgtm_qp.errors import SolverError
from vgtm_qp.methods import Resolver
from vgtm_qp.qp.answer import Accuracy, Move
from vgtm_qp.qp.long.select import chain_solver
from vgtm_qp.step.chain_engine import ChainEngine
from vgtm_qp.step.engine import Engine
from vgtm_qp.step.target import QPInput

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")

MODULES = {
    "octahedral": (lambda: modules.octahedral(6), ("position",)),
    "hexapod": (lambda: modules.hexapod(3), ("position", "orientation")),
    "longeron": (lambda: modules.longeron(4), ("x", "pointing")),
    "tetrahedral-1": (lambda: modules.tetrahedral(8, actuated=(1,)), ("position",)),
    "tetrahedral-23": (lambda: modules.tetrahedral(6, actuated=(2, 3)), ("position",)),
    "locked": (lambda: lock_members(modules.octahedral(4), ["B2-1", "B4-3"]), ("position", "pointing")),
}
SQUARE = ("octahedral", "longeron")
ACCURACY = Accuracy(1e-10, 1e-8, np.inf)


def make_engine(name, *, vertices, hard, solver=None):
    truss, track = MODULES[name]
    layout, task = make_layout(truss(), track, vertices=vertices, hard_tracking=hard)
    along = chain_solver(layout) if solver is None else chain_solver(layout, solver)
    engine = ChainEngine(along, layout.arm.kinematics(), task)
    for kernel in engine.compiled.kernels:
        assert kernel.compile()
    engine.compiled.library.finish()
    assert engine.compiled.is_ready
    return layout, engine


def moved_by(engine, asked, way):
    """Where a QP leads by C, ``engine.move``, or by NumPy; the error if there is none."""
    rows = replace(asked.rows, lower=asked.rows.lower.copy())
    try:
        return way(engine, asked._replace(rows=rows), ACCURACY, lambda _: None)
    except SolverError as error:
        return error


def assert_same(found: Move, wanted: Move, tolerance: float = 1e-10) -> None:
    """Two moves lead to one place."""
    near = {"atol": tolerance, "rtol": 0.0}
    for which in ("q", "vertices", "progress", "furthest"):
        np.testing.assert_allclose(getattr(found, which), getattr(wanted, which), **near, err_msg=which)
    np.testing.assert_allclose(found.solution.actuators, wanted.solution.actuators, **near)
    np.testing.assert_allclose(found.solution.progress, wanted.solution.progress, **near)
    assert (found.closed is None) == (wanted.closed is None)
    if found.closed is None or wanted.closed is None:
        return
    for which in ("q", "quantities", "tip_position", "tip_rotation"):
        np.testing.assert_allclose(
            getattr(found.closed, which), getattr(wanted.closed, which), **near, err_msg=which
        )


NUMPY_SOLVE = ChainEngine.solve


def make_asked(layout, k, rng):
    """The input of a QP: boxes of several sizes, along turning and straight paths, of motions and corrections."""
    X, Y, points, target, rows = make_step(layout, layout.arm.kinematics(), rng)
    reach, middle = (1.0, 0.05, 0.02)[k % 3], 0.5 * (target.lower + target.upper)
    path = target.path
    if k % 2:
        path = replace(path, rotations=np.stack([path.rotations[0]] * 2))
    target = replace(target, lower=middle - reach, upper=middle + reach, path=path)
    motion, progress = bool(k % 4), 0.3 * (k % 2)
    at = Y if motion else X
    return QPInput(X, at, points, np.zeros(0), target, target.goal(progress), progress, rows, motion)


@pytest.mark.dear
@pytest.mark.parametrize(
    ("name", "vertices", "hard"),
    [(name, vertices, False) for name in MODULES for vertices in (5, 0)]
    + [(name, 7, True) for name in SQUARE],
)
def test_c_and_numpy_lead_to_one_place(name, vertices, hard, rng, monkeypatch):
    layout, engine = make_engine(name, vertices=vertices, hard=hard)
    by_numpy = []
    monkeypatch.setattr(
        ChainEngine, "solve", lambda self, asked: by_numpy.append(1) or NUMPY_SOLVE(self, asked)
    )
    compared = 0
    for k in range(12):
        asked = make_asked(layout, k, rng)
        free, rows = moved_by(engine, asked, Engine.move), asked.rows
        if isinstance(free, Move) and k % 2:
            value = np.einsum("rsc,rsc->r", rows.coefficients, (free.q - asked.q)[rows.nodes])
            asked = asked._replace(rows=replace(rows, lower=value + np.array([1e-4, -1e-2, 2e-4])))
        by_numpy.clear()
        wanted = moved_by(engine, asked, Engine.move)
        # A QP that has no answer with the margin of clearance is left to NumPy.
        is_left = len(by_numpy) > 1
        by_numpy.clear()
        found = moved_by(engine, asked, ChainEngine.move)
        if isinstance(wanted, SolverError):
            assert type(found) is type(wanted)
            continue
        assert isinstance(found, Move), found
        assert is_left or not by_numpy
        assert_same(found, wanted)
        for which in ("actuator_multipliers", "clearance_multipliers"):
            np.testing.assert_allclose(
                getattr(found.solution, which), getattr(wanted.solution, which), atol=1e-8
            )
        compared += 1
    assert compared > 3


@pytest.mark.parametrize("tracking", ["elastic", "hard"])
def test_whole_maneuvers_by_c_and_by_numpy(tracking, monkeypatch):
    """The arm goes between the cubes, which press on it, and half of the way back."""
    (scene,) = make_scenes(["cubes"], [26], [tracking])
    states = []
    for by_c in (True, False):
        if not by_c:
            monkeypatch.setenv("VGTM_CC", "none")
        resolver = Resolver(scene.problem)
        engine = resolver.setup.engine
        assert isinstance(engine, ChainEngine)
        if by_c:
            assert all(kernel.compile() for kernel in engine.compiled.kernels)
            assert engine.compiled.library.finish()
        assert engine.compiled.is_ready == by_c
        tour = Tour(make_goals(scene.problem, resolver))
        for _ in range(120):
            step = resolver.step(position=tour.goal.pose.position)
            tour.advance(step)
        states.append((resolver.state, tour.covered))
    (first, covered), (second, also) = states
    assert covered == also > 0.9
    np.testing.assert_allclose(first.nodes, second.nodes, atol=1e-10)
    np.testing.assert_allclose(first.quantities, second.quantities, atol=1e-10)
    np.testing.assert_allclose(first.control_vertices, second.control_vertices, atol=1e-10)


def test_room_for_rows_grows(rng):
    """Of many rows that press, all are kept: the dense QP grows."""
    layout, engine = make_engine("octahedral", vertices=5, hard=False)
    engine.compiled.widen(4)
    asked = make_asked(layout, 1, rng)
    wanted = moved_by(engine, asked, Engine.move)
    assert isinstance(wanted, Move)
    assert_same(moved_by(engine, asked, ChainEngine.move), wanted)
