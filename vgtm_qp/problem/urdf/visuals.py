"""Visual shapes of a URDF as triangles with colours, to be drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vgtm_qp.arrays import Array, Index
from vgtm_qp.problem.urdf.frames import Frame
from vgtm_qp.problem.urdf.shapes import Shapes, mesh_unit
from vgtm_qp.problem.urdf.text import Element

_GREY = (0.75, 0.76, 0.78)
"""Colour of what has none."""
_GREATEST_FACES = 500_000


@dataclass(frozen=True, eq=False)
class UrdfVisual:
    """A surface that moves with a joint.

    Attributes
    ----------
    joint : int
        Number of moving joints before it; 0 is fixed to the base.
    vertices, faces : (K, 3), (F, 3) int
        Triangles, m, in the frame of the last of these joints.
    colour : (float, float, float)
        Red, green and blue, 0 to 1.
    """

    joint: int
    vertices: Array
    faces: Index
    colour: tuple[float, float, float]


def surfaces_of(visual: Element, joint: int, frame: Frame, shapes: Shapes, root: Element) -> list[UrdfVisual]:
    """Return the surfaces of a <visual>, one of each colour; none if its shape or its file is missing or damaged.

    `frame` is that of its <origin> in the frame of the joint, `root` the robot, whose materials have names.
    """
    geometry = visual.first("geometry")
    try:
        parts = _parts(geometry.children[0], shapes) if geometry is not None else []
    except (
        Exception
    ):  # trimesh raises whatever the reader of the format raises, and attributes may be missing
        return []
    own, found = _colour(visual.first("material"), root), dict[Any, list[Any]]()
    for part in parts:
        found.setdefault(own or _main_colour(part), []).append(part)
    surfaces = []
    for colour, meshes in found.items():
        vertices = np.concatenate([np.asarray(mesh.vertices, dtype=float) for mesh in meshes])
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
        faces = [
            np.asarray(mesh.faces, dtype=np.int64) + start for mesh, start in zip(meshes, starts, strict=True)
        ]
        surfaces.append(
            UrdfVisual(joint, frame[0] + vertices @ frame[1].T, np.concatenate(faces), colour or _GREY)
        )
    return surfaces


def _parts(shape: Element, shapes: Shapes) -> Sequence[Any]:
    """Return the meshes that a shape consists of, in its own frame."""
    import trimesh

    def numbers(key: str, default: str | None = None) -> list[float]:
        text = shape.attributes[key] if default is None else shape.attributes.get(key, default)
        return [float(part) for part in text.split()]

    made = trimesh.creation
    if shape.tag == "sphere":
        return [made.icosphere(subdivisions=3, radius=numbers("radius")[0])]
    if shape.tag == "box":
        return [made.box(extents=numbers("size"))]
    if shape.tag == "cylinder":
        return [made.cylinder(radius=numbers("radius")[0], height=numbers("length")[0], sections=48)]
    if shape.tag == "capsule":
        capsule = made.capsule(radius=numbers("radius")[0], height=numbers("length")[0])
        # Not every version of trimesh puts its middle at the origin.
        capsule.apply_translation(-capsule.bounds.mean(axis=0))
        return [capsule]
    file = shapes.found(shape.attributes["filename"])
    return [] if file is None else _of_file(file, np.array(numbers("scale", "1 1 1")))


def _of_file(file: Path, scale: Array) -> list[Any]:
    """Return the meshes in a file, in metres."""
    import trimesh

    loaded = trimesh.load(file, force="scene")
    parts = [part for part in loaded.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if sum(len(part.faces) for part in parts) > _GREATEST_FACES:
        return []
    for part in parts:
        part.apply_scale(scale * mesh_unit(file))
    return [part for part in parts if np.isfinite(part.vertices).all()]


def _main_colour(part: Any) -> tuple[float, float, float] | None:
    """Return the colour of a mesh by its file, None if that gives none."""
    if getattr(part.visual, "kind", None) is None:
        return None
    try:
        colour = part.visual.material.main_color if part.visual.kind == "texture" else part.visual.main_color
    except AttributeError:
        return None
    red, green, blue = (float(channel) / 255.0 for channel in colour[:3])
    return red, green, blue


def _colour(material: Element | None, root: Element) -> tuple[float, float, float] | None:
    """Return the colour of a <material>, its own or that of the robot's material of its name; None without one."""
    if material is None:
        return None
    name = material.attributes.get("name")
    named = [one for one in root.all("material") if one.attributes.get("name") == name]
    for one in (material, *named):
        colour = one.first("color")
        text = "" if colour is None else colour.attributes.get("rgba", "")
        try:
            red, green, blue = map(float, text.split()[:3])
        except ValueError:
            continue
        return red, green, blue
    return None
