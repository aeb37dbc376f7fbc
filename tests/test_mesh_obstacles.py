"""Whole maneuvers past meshes from STL and OBJ files, one with a hole that the arm stands in."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from recovery_problems import problem

import vgtm_qp as vq


@pytest.fixture(scope="module", params=["stl", "obj"])
def ring(request, tmp_path_factory):
    """A ring that is no convex body: its hull is a disc without a hole."""
    path = tmp_path_factory.mktemp("meshes") / f"ring.{request.param}"
    mesh = trimesh.creation.annulus(0.95, 1.25, 0.2)
    assert not mesh.is_convex
    mesh.export(path)
    return path


def inside(ring, height=1.9, velocity=(0.0, 0.0, 0.0), goal=(0.5, 0.0, 2.1)):
    obstacle = {"name": "ring", "shape": "mesh", "file": str(ring), "center": [0.0, 0.0, height]}
    waypoint = [{"time": 4.0, "position": list(goal)}]
    return problem(obstacle=[{**obstacle, "velocity": list(velocity)}], **{"maneuver.waypoint": waypoint})


@pytest.mark.parametrize("velocity", [(0.0, 0.0, 0.0), (0.02, 0.0, 0.0)])
def test_an_arm_moves_inside_a_ring_and_keeps_clear_of_it(ring, velocity):
    maneuver = vq.solve(inside(ring, velocity=velocity))
    assert maneuver.status == "solved"
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    assert 0.08 - 1e-9 <= maneuver.clearance.min() <= 0.15


def test_an_arm_gives_way_to_a_ring_that_moves(ring):
    changes = {"velocity": (-0.07, 0.0, 0.0), "goal": (0.3, 0.1, 2.3)}
    maneuver = vq.solve(inside(ring, **changes))
    assert maneuver.status == "solved"
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    careless = vq.solve(problem(**{"maneuver.waypoint": [{"time": 4.0, "position": [0.3, 0.1, 2.3]}]}))
    setup = vq.Resolver(inside(ring, **changes)).setup
    nearest = min(
        setup.monitor.least(nodes, time, among="obstacles")[0]
        for nodes, time in zip(careless.nodes, careless.time, strict=True)
    )
    assert nearest < 0.08 - 1e-3


def test_a_ring_in_the_way_is_named_and_without_it_the_arm_gets_further(ring):
    goal = (1.3, 0.0, 1.7)
    blocked, free = (
        vq.solve(inside(ring, goal=goal)),
        vq.solve(inside(ring, goal=goal).replace({"obstacle": []})),
    )
    assert blocked.status == "blocked"
    assert blocked.certificate.ok, blocked.certificate.failures()
    assert blocked.manifest["stop"]["obstacles"] == ["ring"]
    assert free.reached > blocked.reached + 0.05
    assert np.all(blocked.clearance >= 0.08 - 1e-9)
