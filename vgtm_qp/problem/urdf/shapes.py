"""Collision shapes of a URDF, each enclosed by a capsule."""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import MissingExtraError, ProblemError
from vgtm_qp.problem.urdf.text import Element, Mistakes

Array = NDArray[np.float64]
Capsule = tuple[Array, float]
"""Both ends of the axis (2, 3), or its one point (1, 3), and the radius, m."""

_ROUNDING = 1e-12
_RADII = np.linspace(1.0, 1.6, 61)
"""Radii that are tried, over the least possible one: a thicker capsule may be shorter."""
_STEPS = 100
_GREATEST_POINTS = 2_000_000
_HEAD = 1_000_000
"""Bytes at the beginning of a COLLADA file in which its unit is searched."""
_KINDS = "box, cylinder, sphere, capsule, mesh"


class Shapes:
    """Encloses collision shapes; finds the files of their meshes.

    `files` are the files that were read.
    """

    def __init__(self, urdf: Path, packages: Sequence[Path], mistakes: Mistakes) -> None:
        self._urdf, self._packages, self._mistakes = urdf, packages, mistakes
        self.files: list[Path] = []
        self._meshes: dict[Path, Array] = {}

    def enclosing(self, collision: Element, what: str) -> Capsule | None:
        """Return the capsule round a <collision> in the frame of its <origin>; None where the shape is wrong."""
        geometry = collision.first("geometry")
        shapes = [] if geometry is None else geometry.children
        if geometry is None or len(shapes) != 1:
            found = None if not shapes else ", ".join(f"<{shape.tag}>" for shape in shapes)
            self._mistakes.add(collision, f"{what}, <geometry>", found, f"one of {_KINDS}")
            return None
        shape, mistakes = shapes[0], self._mistakes
        if shape.tag == "sphere":
            return np.zeros((1, 3)), mistakes.length(shape, what, "radius")
        if shape.tag == "capsule":
            half = 0.5 * mistakes.length(shape, what, "length")
            return np.array([[0.0, 0.0, -half], [0.0, 0.0, half]]), mistakes.length(shape, what, "radius")
        if shape.tag == "cylinder":
            half = 0.5 * mistakes.length(shape, what, "length")
            rim = np.full(2, mistakes.length(shape, what, "radius"))
            return _capsule(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([-half, half]), rim)
        if shape.tag == "box":
            corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T
            return enclosing_capsule(corners * mistakes.lengths(shape, what, "size", 3))
        if shape.tag == "mesh":
            points = self._mesh(shape, what)
            return None if points is None else enclosing_capsule(points)
        mistakes.add(shape, what, f"<{shape.tag}>", f"one of {_KINDS}")
        return None

    def _mesh(self, shape: Element, what: str) -> Array | None:
        """Return points (K, 3) whose convex hull holds a mesh, m."""
        name, link, what = shape.attributes.get("filename"), what, f"{what}, <mesh>"
        if not name:
            self._mistakes.add(shape, f"{what} filename", name, "the path of an STL, OBJ or DAE file")
            return None
        if name.startswith("package:///"):
            expected = "package://, the name of a package, and the path in it"
            self._mistakes.add(shape, f"{what} filename", name, expected)
            return None
        scale = self._mistakes.numbers(shape, link, "scale", 3, (1.0, 1.0, 1.0))
        if scale is None:
            return None
        if not all(scale):
            expected = "three numbers, none of them 0"
            self._mistakes.add(shape, f"{what} scale", shape.attributes["scale"], expected)
            return None
        tried = list(self._places(name))
        file = next((path for path in tried if _is_file(path)), None)
        if file is None:
            places = ", ".join(str(path) for path in tried[:4])
            self._mistakes.add(
                shape, f"{what} filename", name, f"a file that exists; there is none at {places}"
            )
            return None
        if file not in self._meshes:
            try:
                self._meshes[file] = _read_mesh(file)
            except ProblemError as error:
                self._mistakes.add(shape, f"{what} filename", name, error.mistakes[0].expected)
                return None
            self.files.append(file)
        return np.asarray(self._meshes[file] * np.array(scale))

    def _places(self, name: str) -> list[Path]:
        """Return the paths at which the file of a mesh may be, in the order of search."""
        beside = self._urdf.parent
        if not name.startswith("package://"):
            return [beside / unquote(name.removeprefix("file://"))]
        rest = unquote(name.removeprefix("package://"))
        package, _, inner = rest.partition("/")
        places = [path / part for path in self._packages for part in (rest, inner)]
        for folder in (beside, *beside.parents):
            places += [folder / rest] + ([folder / inner] if folder.name == package else [])
        return places


def enclosing_capsule(points: Array) -> Capsule:
    """Return a small capsule that holds points (K, 3): the smallest over axes along and near their principal ones."""
    from scipy.optimize import minimize

    centred = points - points.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=True)[2]

    def along(tilt: Array, frame: Array) -> Capsule:
        direction = frame[0] + tilt[0] * frame[1] + tilt[1] * frame[2]
        direction = direction / np.linalg.norm(direction)
        across = np.linalg.svd(direction[None])[2][1:]
        middle = _centre(points @ across.T)
        centre = middle @ across
        gap = points - centre
        return _capsule(centre, direction, gap @ direction, np.linalg.norm(gap @ across.T, axis=1))

    frames = [np.roll(axes, -k, axis=0) for k in range(3)]
    best = min(frames, key=lambda frame: _volume(along(np.zeros(2), frame)))
    options = {"maxfev": 60, "initial_simplex": [[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]]}
    tilt = minimize(
        lambda tilt: _volume(along(tilt, best)), np.zeros(2), method="Nelder-Mead", options=options
    ).x
    return min((along(np.zeros(2), best), along(tilt, best)), key=_volume)


def _capsule(centre: Array, direction: Array, along: Array, aside: Array) -> Capsule:
    """Return the smallest capsule on a line that holds points at distances `along` and `aside` of it (K,), m."""
    least = float(aside.max())
    # With the radius of the whole extent the capsule is a ball.
    extent = float(np.hypot(least, 0.5 * np.ptp(along)))
    found = []
    for radius in np.minimum(least * _RADII, extent) if least > 0.0 else [extent]:
        # How far the caps reach beyond the axis's ends at each point.
        cap = np.sqrt(np.maximum(radius**2 - aside**2, 0.0))
        low, high = float((along + cap).min()), float((along - cap).max())
        if low > high:
            low = high = 0.5 * (low + high)
        ends = centre + np.array([[low], [high]]) * direction
        found.append((ends, float(radius)))
    ends, _ = min(found, key=_volume)
    points = centre + along[:, None] * direction
    length = float(np.linalg.norm(ends[1] - ends[0]))
    share = np.clip((points - ends[0]) @ direction, 0.0, length)
    # The radius grows by what rounding left outside.
    needed = np.hypot((points - ends[0]) @ direction - share, aside).max()
    size = float(np.abs(ends).max()) + float(needed)
    return ends, float(needed) + _ROUNDING * size


def _volume(capsule: Capsule) -> float:
    ends, radius = capsule
    return float(np.pi * radius**2 * (np.linalg.norm(ends[-1] - ends[0]) + 4.0 / 3.0 * radius))


def _centre(points: Array) -> Array:
    """Return (2,) nearly the centre of the smallest circle round points (K, 2) (Badoiu and Clarkson 2003)."""
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    best, least = centre, np.inf
    for k in range(1, _STEPS):
        gaps = points - centre
        squares = (gaps * gaps).sum(axis=1)
        furthest = int(np.argmax(squares))
        if squares[furthest] < least:
            best, least = centre, squares[furthest]
        centre = centre + gaps[furthest] / (k + 1)
    return np.asarray(best)


def _read_mesh(file: Path) -> Array:
    """Return points (K, 3) whose hull is that of a mesh file."""
    import trimesh

    if file.suffix.lower() == ".dae" and find_spec("collada") is None:
        expected = f"an STL or OBJ file; for COLLADA {MissingExtraError('dae', 'pycollada')}"
        raise ProblemError.at(file, "file", "", expected)
    try:
        # By default trimesh silently skips COLLADA parts with broken references.
        how = {".dae": {"ignore_broken": False}, ".obj": {"skip_materials": True}}
        mesh = trimesh.load(file, force="mesh", **how.get(file.suffix.lower(), {}))
        mesh.apply_scale(_unit(file))
        points = np.asarray(mesh.vertices, dtype=float).reshape(-1, 3)
    except Exception as error:  # trimesh raises whatever the reader of the format raises
        raise ProblemError.at(file, "file", "", f"an STL, OBJ or DAE file; {str(error)[:200]}") from None
    if not 3 <= len(points) <= _GREATEST_POINTS or not np.isfinite(points).all():
        raise ProblemError.at(file, "file", "", "a mesh with 3 finite points or more")
    try:
        return np.asarray(mesh.convex_hull.vertices, dtype=float)
    except Exception:  # a flat mesh has no hull with a volume
        return points


def _unit(file: Path) -> float:
    """Return the unit of length of a mesh file, m: COLLADA files have one, which trimesh does not apply."""
    if file.suffix.lower() != ".dae":
        return 1.0
    with file.open("rb") as stream:
        found = re.search(rb"<unit\b[^>]*?\bmeter\s*=\s*[\"']([^\"']*)[\"']", stream.read(_HEAD))
    unit = 1.0 if found is None else float(found[1])
    if not 0.0 < unit < np.inf:
        raise ValueError(f"its unit is {unit:g} m")
    return unit


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False
