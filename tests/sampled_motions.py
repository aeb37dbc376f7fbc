"""Serial arms at random instants between their states, by arithmetic of its own: nothing is shared with the package.

    python tests/sampled_motions.py --scenes 1000 --seed 20261215 --rows sampled.jsonl

solves every tenth scene of the study ``robustness`` and looks at 10,000 instants of each step. Scenes that are in the
file of rows already are not solved again.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from geometry_reference import POINT
from scipy.spatial import ConvexHull, cKDTree

GRID = 6
"""Parts of the edge of a hull's face, with a point at each corner of their grid."""
BETWEEN, AT = 1e-4, 1e-9
"""Published tolerances of a clearance: between states, over the mean link, and at states, m."""


def turns(vectors):
    """Rotations (S, 3, 3) by vectors (S, 3), rad."""
    angle = np.linalg.norm(vectors, axis=-1)[:, None, None]
    x, y, z = np.moveaxis(vectors, -1, 0) / np.where(angle > 0.0, angle, 1.0)[:, 0, 0]
    zero = np.zeros_like(x)
    K = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * (K @ K)


def turn(vector):
    return turns(np.array([vector], dtype=float))[0]


def surface(points):
    """Points (K, 3) all over the surface of the convex hull of points (V, 3), on a grid over each of its faces."""
    corners = np.array(points)[ConvexHull(points).simplices]
    grid = np.array([(i, j) for i in range(GRID + 1) for j in range(GRID + 1 - i)]) / GRID
    weights = np.column_stack([grid, 1.0 - grid.sum(axis=1)])
    return np.unique((weights @ corners).reshape(-1, 3).round(12), axis=0)


class Cloud:
    """A hull as points of its surface, which are fixed in frames: places (S, 3) and attitudes (S, 3, 3)."""

    def __init__(self, points, frame):
        self.own, (self.place, self.attitude) = surface(points), frame
        self.middle = np.mean(points, axis=0)
        self.reach = float(np.linalg.norm(np.array(points) - self.middle, axis=1).max())

    def at(self, rows):
        """The points (R, K, 3) at some instants."""
        return self.place[rows, None] + self.own @ np.swapaxes(self.attitude[rows], 1, 2)


def bodies_of(table, joints, time):
    """Ends (S, B, 2, 3), m, radii (B,), and hulls by number, at joint values (S, J) and times (S,).

    The ends of a hull are twice its middle.
    """
    R, place = np.tile(np.eye(3), (len(joints), 1, 1)), np.zeros((len(joints), 3))
    if table["base_motion"]:
        (pose,) = table["base_motion"]
        share = np.minimum(time / pose["time"], 1.0)[:, None]
        R, place = turns(share * pose["rotation_vector"]), share * np.array(pose["position"])
    frames, places = {}, []
    for joint, value in zip(table["joint"], joints.T, strict=True):
        axis = np.array(joint["axis"]) / np.linalg.norm(joint["axis"])
        place = place + R @ joint["position"]
        R = R @ turn(joint["rotation_vector"])
        places.append(place)
        if joint["kind"] == "revolute":
            R = R @ turns(value[:, None] * axis)
        else:
            place = place + value[:, None] * (R @ axis)
        frames[joint["name"]] = place, R
    places.append(place + R @ table["tip"])
    if table.get("body"):
        ends, clouds = [], {}
        for k, body in enumerate(table["body"]):
            at, attitude = frames[body["joint"]]
            points = body["points"][0], body["points"][-1]
            if len(body["points"]) > 2:
                clouds[k] = Cloud(body["points"], (at, attitude))
                points = [clouds[k].middle] * 2
            ends.append([at + attitude @ point for point in points])
        radii = np.array([body["radius"] for body in table["body"]])
        return np.moveaxis(np.array(ends), 2, 0), radii, clouds
    ways = [*(joint["position"] for joint in table["joint"][1:]), table["tip"]]
    kinds = [joint["kind"] for joint in table["joint"]]
    kept = [k for k, way in enumerate(ways) if any(way) or kinds[k] == "prismatic"]
    ends = np.array([[places[k], places[k + 1]] for k in kept])
    return np.moveaxis(ends, 2, 0), np.full(len(kept), table["link_radius"]), {}


def mean_link(table):
    ways = [np.linalg.norm(part) for part in (*(joint["position"] for joint in table["joint"]), table["tip"])]
    return float(np.mean([way for way in ways if way > 0.0]))


def solid(obstacle):
    """A function from points (..., 3) in the obstacle's place at time 0 to distances from it, and its outer radius."""
    center, R = np.array(obstacle["center"]), turn(obstacle["rotation_vector"]).reshape(-1)
    if obstacle["shape"] == "box":
        half = np.broadcast_to(np.array(obstacle["size"]) / 2.0, 3)
        return lambda x: POINT["box"](x, np.r_[center, R, half]), float(np.linalg.norm(half))
    if obstacle["shape"] == "sphere":
        radius = obstacle["radius"]
        return lambda x: np.maximum(POINT["sphere"](x, np.r_[center, R, radius]), 0.0), radius
    if obstacle["shape"] == "cylinder":
        radius, half = obstacle["radius"], obstacle["height"] / 2.0
        return lambda x: POINT["cylinder"](x, np.r_[center, R, radius, half]), float(np.hypot(radius, half))
    # The only mesh of the scenes is an octahedron with corners on the axes.
    scale = obstacle["scale"]
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    faces = [center + (np.diag(sign) * scale) @ R.reshape(3, 3).T for sign in signs]

    def octahedron(x):
        outside = np.abs((x - center) @ R.reshape(3, 3)).sum(axis=-1) > scale
        return outside * np.min([POINT["triangle"](x, face.reshape(-1)) for face in faces], axis=0)

    return octahedron, scale


def from_solid(distance, ends):
    """Distances (S,) of segments (S, 2, 3) from a solid: convex along a segment, so that a third of it can go."""
    low, high, way = np.zeros(len(ends)), np.ones(len(ends)), ends[:, 1] - ends[:, 0]
    for _ in range(50):
        thirds = (high - low) / 3.0
        first, second = (distance(ends[:, 0] + s[:, None] * way) for s in (low + thirds, high - thirds))
        low, high = np.where(first > second, low + thirds, low), np.where(first > second, high, high - thirds)
    return distance(ends[:, 0] + ((low + high) / 2.0)[:, None] * way)


def at_least(distance, ends):
    """Lower bounds (S,) of these distances: from the middles of eight parts, less half of a part."""
    way = ends[:, 1] - ends[:, 0]
    least = np.min([distance(ends[:, 0] + s * way) for s in (np.arange(8) + 0.5) / 8.0], axis=0)
    return least - np.linalg.norm(way, axis=1) / 16.0


def from_segment(one, other):
    """Distances (S,) of segments (S, 2, 3): the least over the lines, or with one of the four ends."""
    d, e, r = one[:, 1] - one[:, 0], other[:, 1] - other[:, 0], one[:, 0] - other[:, 0]
    a, b, c, f, g = ((u * v).sum(axis=1) for u, v in ((d, d), (d, e), (e, e), (d, r), (e, r)))
    tiny = 1e-300
    determinant = a * c - b * b
    s, t = ((u / np.where(determinant > tiny, determinant, 1.0)) for u in (b * g - c * f, a * g - b * f))
    inside = (determinant > tiny) & (s >= 0.0) & (s <= 1.0) & (t >= 0.0) & (t <= 1.0)
    least = np.where(inside, np.linalg.norm(r + s[:, None] * d - t[:, None] * e, axis=1), np.inf)
    for point, segment in ((one, other), (other, one)):
        way = segment[:, 1] - segment[:, 0]
        square = np.maximum((way * way).sum(axis=1), tiny)
        for k in (0, 1):
            off = point[:, k] - segment[:, 0]
            share = np.clip((off * way).sum(axis=1) / square, 0.0, 1.0)
            least = np.minimum(least, np.linalg.norm(off - share[:, None] * way, axis=1))
    return least


def from_cloud(points, distance):
    """Distances (S,) of points (S, K, 3) from a solid: no less than that of their hull."""
    return distance(points.reshape(-1, 3)).reshape(points.shape[:2]).min(axis=1)


def between_clouds(one, other):
    """Distances (S,) of points (S, K, 3) from points (S, L, 3)."""
    return np.array([cKDTree(a).query(b)[0].min() for a, b in zip(one, other, strict=True)])


def between_bodies(one, other, ends):
    """Distances (S,) of two bodies, clouds or None, the latter with `ends` (S, 2, 3) each."""
    if one is None and other is None:
        return from_segment(*ends)
    if one is not None and other is not None:
        return between_clouds(one, other)
    cloud, (a, b) = (
        (one, np.moveaxis(ends[1], 1, 0)) if other is None else (other, np.moveaxis(ends[0], 1, 0))
    )
    way = b - a
    off = cloud - a[:, None]
    square = np.maximum((way * way).sum(axis=1), 1e-300)
    share = np.clip(np.einsum("skc,sc->sk", off, way) / square[:, None], 0.0, 1.0)
    return np.linalg.norm(off - share[..., None] * way[:, None], axis=2).min(axis=1)


def spare(maneuver, samples, random):
    """Least clearance over that asked for, m, with its pair and time: at the states, and at random instants between."""
    problem, arm = maneuver.manifest["problem"], maneuver.manifest["arm"]
    table, rules = problem["arm"], problem["clearance"]
    self_safe = rules["safe"] / 4.0 if rules.get("self_safe") is None else rules["self_safe"]
    solids = [(*solid(obstacle), obstacle) for obstacle in problem["obstacle"]]
    joined, apart = arm["joined"], {tuple(sorted(pair)) for pair in arm["touching"]}
    count = len(joined) if rules["self_collision"] else 0
    pairs = [
        (m, k)
        for m in range(count)
        for k in range(m + 1, count)
        if not set(joined[m]) & set(joined[k]) and (m, k) not in apart
    ]
    known = {entry["pair"]: entry["distance"] for entry in maneuver.manifest["recovered"]}
    least = {"at": (np.inf, "", 0.0), "between": (np.inf, "", 0.0)}

    def note(distance, floor, name, time, is_state):
        floor = min(floor, known.get(name, np.inf))
        for place, mask in (("at", is_state), ("between", ~is_state)):
            if mask.any() and (value := float((found := distance[mask] - floor).min())) < least[place][0]:
                least[place] = value, name, float(time[mask][int(found.argmin())])

    names = arm["body_names"]
    for k in range(len(maneuver.time) - 1):
        share = np.r_[0.0, 1.0, random.random(samples)]
        time = (1.0 - share) * maneuver.time[k] + share * maneuver.time[k + 1]
        joints = (1.0 - share)[:, None] * maneuver.joints[k] + share[:, None] * maneuver.joints[k + 1]
        ends, radius, clouds = bodies_of(table, joints, time)
        assert ends.shape[1] == len(names)
        reach = np.array([clouds[m].reach if m in clouds else 0.0 for m in range(len(names))])
        middle, half = ends.mean(axis=2), np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2) / 2.0 + reach
        low, high = ends.min(axis=(0, 2)) - reach[:, None], ends.max(axis=(0, 2)) + reach[:, None]
        is_state = share * (1.0 - share) == 0.0
        for distance, size, obstacle in solids:
            moved = time[:, None] * np.array(obstacle["velocity"])
            at = np.array(obstacle["center"]) + moved
            box = np.maximum(np.maximum(low - at.max(axis=0), at.min(axis=0) - high), 0.0)
            for m in np.flatnonzero(np.linalg.norm(box, axis=1) < size + radius + rules["safe"] + 0.05):
                off = np.linalg.norm(middle[:, m] - at, axis=1) - size - half[:, m] - radius[m]
                near = off < rules["safe"] + 0.01
                at_rest = ends[:, m] - moved[:, None]
                if m not in clouds:
                    near[near] = at_least(distance, at_rest[near]) - radius[m] < rules["safe"] + 0.01
                if near.any():
                    if m in clouds:
                        found = from_cloud(clouds[m].at(near) - moved[near, None], distance) - radius[m]
                    else:
                        found = from_solid(distance, at_rest[near]) - radius[m]
                    note(found, rules["safe"], f"{names[m]} / {obstacle['name']}", time[near], is_state[near])
        for m, j in pairs:
            box = np.maximum(np.maximum(low[m] - high[j], low[j] - high[m]), 0.0)
            thick = radius[m] + radius[j]
            if np.linalg.norm(box) < thick + self_safe + 0.05:
                off = np.linalg.norm(middle[:, m] - middle[:, j], axis=1) - half[:, m] - half[:, j] - thick
                near = off < self_safe + 0.01
                if near.any():
                    own = [clouds[k].at(near) if k in clouds else None for k in (m, j)]
                    found = between_bodies(*own, (ends[near, m], ends[near, j])) - thick
                    note(found, self_safe, f"{names[m]} / {names[j]}", time[near], is_state[near])
    return least


def is_safe(maneuver, least):
    between = BETWEEN * mean_link(maneuver.manifest["problem"]["arm"])
    return least["at"][0] >= -AT and least["between"][0] >= -between


def main():
    from vgtm_qp.errors import ProblemError
    from vgtm_qp.maneuver.solve import solve
    from vgtm_qp.study.varied import varied_scene

    options = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    for name, value in (("scenes", 1000), ("seed", 1991), ("every", 10), ("samples", 10_000), ("steps", 30)):
        options.add_argument(f"--{name}", type=int, default=value)
    options.add_argument("--rows", type=Path, default=Path("sampled.jsonl"))
    given = options.parse_args()
    known = [json.loads(line) for line in given.rows.read_text().splitlines()] if given.rows.exists() else []
    done = {row["number"] for row in known if row["seed"] == given.seed}
    with given.rows.open("a") as file:
        for number in range(0, given.scenes, given.every):
            if number in done:
                continue
            row = {"seed": given.seed, "number": number, "samples": given.samples}
            try:
                maneuver = solve(
                    varied_scene(given.seed, number, steps=given.steps, arms="serial"), verify=False
                )
            except ProblemError:
                row |= {"steps": 0, "safe": True}
            else:
                least = spare(maneuver, given.samples, np.random.default_rng([given.seed, number]))
                row |= {"steps": maneuver.steps, "safe": is_safe(maneuver, least), "least": least}
            known.append(row)
            file.write(json.dumps(row).replace("Infinity", "1e999") + "\n")
            file.flush()
    rows = [row for row in known if row["seed"] == given.seed]
    unsafe = [row["number"] for row in rows if not row["safe"]]
    print(
        f"{len(rows)} scenes, {sum(row['steps'] for row in rows)} steps, {given.samples} instants each: unsafe {unsafe}"
    )


if __name__ == "__main__":
    main()
