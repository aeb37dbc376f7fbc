"""Monitors of random scenes, and the distance of every pair of a monitor, one by one."""

import numpy as np
from geometry_reference import segment_distance
from scipy.spatial.transform import Rotation

from vgtm_qp.geometry.bodies import capsules
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.geometry.groups import Group
from vgtm_qp.geometry.shapes import box, cylinder, mesh, sphere

SHIFT = {"box": [0], "sphere": [0], "cylinder": [0], "triangle": [0, 3, 6]}

MEMBERS = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (0, 2), (1, 4)]


def random_clearance(rng, velocity, *, meshes=(), round_numbers=False):
    """Six nodes, and a monitor of their members among a box, a ball, a post and meshes, each with a `velocity()`."""

    def vector(bound):
        v = rng.uniform(-bound, bound, 3)
        return np.round(4.0 * v) / 4.0 if round_numbers else v

    def turn():
        return (
            np.eye(3) if round_numbers else Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
        )

    obstacles = [
        box("box", vector(2.0), rng.choice([0.25, 0.5, 0.75], 3), turn(), velocity()),
        sphere("ball", vector(2.0), 0.25, velocity()),
        cylinder("post", vector(2.0), 0.25, 1.0, turn(), velocity()),
        *(mesh("wedge", surface, vector(2.0), turn(), 0.5, velocity()) for surface in meshes),
    ]
    nodes = np.array([vector(1.5) for _ in range(6)])
    return nodes, Clearance(capsules(MEMBERS, 0.03), obstacles, safe=0.08, influence=0.5)


def piece_at(clearance, piece, time):
    row = clearance.pieces.parameters[piece].copy()
    for first in SHIFT[str(clearance.pieces.shape[piece])]:
        row[first : first + 3] += time * clearance.pieces.velocity[piece]
    return row


def brute_force(clearance, X, time):
    """Surface distance of each pair (member, other, is_self); minus the radii where axes intersect."""
    ends = X[clearance.bodies.points].reshape(-1, 6)
    distances = {}
    for m, radius in enumerate(clearance.bodies.radius):
        for p, shape in enumerate(clearance.pieces.shape):
            axis = segment_distance(str(shape), ends[m], piece_at(clearance, p, time))
            distances[m, p, False] = axis - radius
        for k in range(m + 1, len(clearance.bodies.radius) if clearance.self_collision else 0):
            if not set(clearance.bodies.points[m]) & set(clearance.bodies.points[k]):
                axis = segment_distance("segment", ends[m], ends[k])
                distances[m, k, True] = axis - radius - clearance.bodies.radius[k]
    return distances


def every_pair(scene, X):
    """Groups of all pairs of a scene, with their distances at `X` (P, 3) and time 0, each evaluated."""
    bodies, pieces = np.arange(len(scene.bodies)), scene.pieces
    pairs = [
        (str(shape), np.tile(bodies, count), np.repeat(np.flatnonzero(pieces.shape == shape), len(bodies)))
        for shape, count in zip(*np.unique(pieces.shape, return_counts=True), strict=True)
    ]
    if scene.has_self:
        first, second = np.triu_indices(len(bodies), 1)
        strangers = ~scene.bodies.may_touch(first, second)
        pairs.append(("segment", first[strangers], second[strangers]))
    groups = [Group(scene, *of) for of in pairs]
    for group in groups:
        group.keep_near(X, 0.0, np.inf)
    return [group for group in groups if len(group)]
