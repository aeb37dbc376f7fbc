"""Collision shapes of a URDF, as balls, capsules and points of hulls."""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import MissingExtraError, ProblemError
from vgtm_qp.problem.enclosing import capsule_along, enclosing_capsule, enclosing_prism, spans_volume
from vgtm_qp.problem.urdf.text import Element, Mistakes

_GREATEST_POINTS = 2_000_000
_HEAD = 1_000_000
"""Bytes at the beginning of a COLLADA file in which its unit is searched."""
_KINDS = "box, cylinder, sphere, capsule, mesh"


RoundedPoints = tuple[Array, float]
"""A ball's centre (1, 3), both ends of a capsule's axis (2, 3), or points (K, 3) of a hull; and the radius, m."""


class Shapes:
    """Makes bodies of collision shapes; finds the files of their meshes.

    `bodies` says what they become, as the key of ``[arm]`` does. `files` are the files that were read.
    """

    def __init__(self, urdf: Path, packages: Sequence[str | Path], mistakes: Mistakes, bodies: str) -> None:
        self._urdf, self._packages = urdf.absolute(), [Path(place).absolute() for place in packages]
        self._mistakes, self._bodies = mistakes, bodies
        self.files: list[Path] = []
        self._meshes: dict[Path, Array] = {}

    def body(self, collision: Element, what: str) -> RoundedPoints | None:
        """Return what stands for a <collision>, in the frame of its <origin>; None where the shape is wrong."""
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
            radius = mistakes.length(shape, what, "radius")
            if self._bodies == "capsule":
                along = np.array([-half, half])
                return capsule_along(np.zeros(3), np.array([0.0, 0.0, 1.0]), along, np.full(2, radius))
            return self._hull(enclosing_prism(radius, half))
        if shape.tag == "box":
            corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T
            return self._hull(corners * mistakes.lengths(shape, what, "size", 3))
        if shape.tag == "mesh":
            if self._bodies == "primitives":
                expected = (
                    'box, cylinder, sphere or capsule: bodies = "primitives" takes no meshes, "hull" does'
                )
                mistakes.add(shape, what, "<mesh>", expected)
                return None
            points = self._mesh(shape, what)
            return None if points is None else self._hull(points)
        mistakes.add(shape, what, f"<{shape.tag}>", f"one of {_KINDS}")
        return None

    def _hull(self, points: Array) -> RoundedPoints:
        """Return the hull of points (K, 3), or a capsule round them if capsules are wanted or they are in one plane."""
        if self._bodies == "capsule" or not spans_volume(points):
            return enclosing_capsule(points)
        return points, 0.0

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
        file = self.found(name)
        if file is None:
            places = ", ".join(str(path) for path in tried[:4])
            more = "; package_path of the problem adds places" if name.startswith("package://") else ""
            expected = f"a file that exists; there is none at {places}{more}"
            self._mistakes.add(shape, f"{what} filename", name, expected)
            return None
        if file not in self._meshes:
            try:
                self._meshes[file] = _read_mesh(file)
            except ProblemError as error:
                self._mistakes.add(shape, f"{what} filename", name, error.mistakes[0].expected)
                return None
            self.files.append(file)
        return np.asarray(self._meshes[file] * np.array(scale))

    def found(self, name: str) -> Path | None:
        """Return the file of a mesh by its name in the URDF, None if there is none."""
        return next((path for path in self._places(name) if _is_file(path)), None)

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
        # The folder of a package may have been renamed: URDF files are in it, or in a folder of it.
        return [*places, beside / inner, beside.parent / inner]


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
        mesh.apply_scale(mesh_unit(file))
        points = np.asarray(mesh.vertices, dtype=float).reshape(-1, 3)
    except Exception as error:  # trimesh raises whatever the reader of the format raises
        raise ProblemError.at(file, "file", "", f"an STL, OBJ or DAE file; {str(error)[:200]}") from None
    if not 3 <= len(points) <= _GREATEST_POINTS or not np.isfinite(points).all():
        raise ProblemError.at(file, "file", "", "a mesh with 3 finite points or more")
    try:
        return np.asarray(mesh.convex_hull.vertices, dtype=float)
    except Exception:  # a flat mesh has no hull with a volume
        return points


def mesh_unit(file: Path) -> float:
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
