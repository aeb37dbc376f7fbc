"""Distances by pointwise formulas and a search along the segment; nothing is shared with the package."""

import numpy as np


def point_box(x, piece):
    local = (x - piece[:3]) @ piece[3:12].reshape(3, 3)
    return np.linalg.norm(np.maximum(np.abs(local) - piece[12:15], 0.0), axis=-1)


def point_sphere(x, piece):
    return np.linalg.norm(x - piece[:3], axis=-1) - piece[12]


def point_cylinder(x, piece):
    local = (x - piece[:3]) @ piece[3:12].reshape(3, 3)
    side = np.hypot(local[..., 0], local[..., 1]) - piece[12]
    end = np.abs(local[..., 2]) - piece[13]
    return np.hypot(np.maximum(side, 0.0), np.maximum(end, 0.0))


def point_segment(x, piece):
    start, axis = piece[:3], piece[3:6] - piece[:3]
    square = axis @ axis
    s = np.clip((x - start) @ axis / square, 0.0, 1.0) if square > 0 else np.zeros(x.shape[:-1])
    return np.linalg.norm(x - start - s[..., None] * axis, axis=-1)


def point_triangle(x, piece):
    corners = piece[:9].reshape(3, 3)
    nearest = np.min([point_segment(x, np.r_[corners[i], corners[(i + 1) % 3]]) for i in range(3)], axis=0)
    face = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    area = np.linalg.norm(face)
    if area < 1e-14:
        return nearest
    face /= area
    sides = [np.cross(corners[(i + 1) % 3] - corners[i], x - corners[i]) @ face for i in range(3)]
    over = np.all(np.array(sides) >= 0.0, axis=0)
    return np.where(over, np.abs((x - corners[0]) @ face), nearest)


POINT = {
    "box": point_box,
    "sphere": point_sphere,
    "cylinder": point_cylinder,
    "segment": point_segment,
    "triangle": point_triangle,
}


def segment_distance(shape, ends, piece):
    """Least pointwise distance along the segment: distance to a convex set is convex, so a zoom finds it."""
    low, high = 0.0, 1.0
    for _ in range(12):
        t = np.linspace(low, high, 31)
        distance = POINT[shape](ends[:3] + t[:, None] * (ends[3:] - ends[:3]), piece)
        k, width = int(distance.argmin()), (high - low) / 30.0
        low, high = max(0.0, t[k] - width), min(1.0, t[k] + width)
    return float(distance.min())


def octahedral_arm(bays):
    """Node positions and members of a straight octahedral arm with unit members."""
    height, radius = np.sqrt(2.0 / 3.0), 1.0 / np.sqrt(3.0)
    nodes, members = [], []
    for face in range(bays + 1):
        angle = 2.0 * np.pi * np.arange(3) / 3.0 + np.pi / 3.0 * face
        nodes += list(
            np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(3, height * face)])
        )
        if face:
            first = 3 * face
            members += [(first + k, first + (k + 1) % 3) for k in range(3)]
            for k in range(first, first + 3):
                below = (
                    first
                    - 3
                    + np.argsort([np.linalg.norm(nodes[k] - nodes[j]) for j in range(first - 3, first)])
                )
                members += [(k, int(j)) for j in below[:2]]
    return np.array(nodes), np.array(members)
