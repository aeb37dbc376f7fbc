"""Obstacles: sets of convex pieces that may move with constant velocity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vgtm_qp.arrays import Array
from vgtm_qp.errors import VgtmError
from vgtm_qp.geometry.exact import WIDTH
from vgtm_qp.problem.fields import GREATEST_LENGTH

_MESH_FORMATS = (".stl", ".obj", ".ply", ".off")


class GeometryError(VgtmError):
    """An obstacle has no volume or cannot be read, or a position is not a number."""


@dataclass(frozen=True, eq=False)
class Obstacle:
    """One named obstacle; make it by `box`, `sphere`, `cylinder` or `mesh`.

    Attributes
    ----------
    name : str
    shape : str
        ``"box"``, ``"sphere"``, ``"cylinder"`` or ``"triangle"`` (a mesh).
    pieces : (P, 15)
        Of each piece at time 0: center (3), rotation (9, row-major, columns are its axes) and half sizes of a box (3),
        radius of a sphere, or radius and half height of a cylinder (third axis), then zeros; or of a triangle the
        vertices (9), counter-clockwise seen from outside, then zeros.
    velocity : (3,)
        m/s.
    solid : bool
        Whether the triangles of a mesh bound a volume; the other shapes are solid.
    allowance : float
        How much nearer bodies may come to it than to other obstacles, m: its distances are greater by that.
    table : Any
        The ``[[obstacle]]`` table that it was made from; None if there is none.
    """

    name: str
    shape: str
    pieces: Array
    velocity: Array = field(default_factory=lambda: np.zeros(3))
    solid: bool = True
    allowance: float = 0.0
    table: Any = None

    def placed(
        self, before: tuple[ArrayLike, ArrayLike], center: ArrayLike, rotation: ArrayLike, velocity: ArrayLike
    ) -> Obstacle:
        """Return the obstacle at another place, with another velocity, m/s.

        Parameters
        ----------
        before
            Center (3,), m, and rotation (3, 3) that it was made with.
        center, rotation
            Those that it shall have at time 0.

        Raises
        ------
        GeometryError
            As `box`.
        """
        turn, at = _rotation(self.name, rotation), _vector(self.name, "center", center)
        pieces = self.pieces.copy()
        if self.shape == "triangle":
            own = (pieces[:, :9].reshape(-1, 3) - np.asarray(before[0])) @ np.asarray(before[1])
            pieces[:, :9] = (own @ turn.T + at).reshape(-1, 9)
        else:
            pieces[:, :3], pieces[:, 3:12] = at, turn.ravel()
        return replace(self, pieces=pieces, velocity=_vector(self.name, "velocity", velocity))


def box(
    name: str,
    center: ArrayLike,
    size: float | ArrayLike,
    rotation: ArrayLike | None = None,
    velocity: ArrayLike = (0.0, 0.0, 0.0),
) -> Obstacle:
    """Return a box.

    Parameters
    ----------
    center : (3,)
        m.
    size : float or (3,)
        Edge of a cube, or the three full edges, m.
    rotation : (3, 3) or None
        Columns are the box's axes.

    Raises
    ------
    GeometryError
        A number is not finite, a size is not positive, or `rotation` is not a rotation.
    """
    half = 0.5 * np.broadcast_to(np.asarray(size, dtype=float), 3)
    return _placed(name, "box", center, rotation, half, velocity)


def sphere(name: str, center: ArrayLike, radius: float, velocity: ArrayLike = (0.0, 0.0, 0.0)) -> Obstacle:
    """Return a sphere; `center` and `radius` in m. Raises as `box`."""
    return _placed(name, "sphere", center, None, np.array([radius]), velocity)


def cylinder(
    name: str,
    center: ArrayLike,
    radius: float,
    height: float,
    rotation: ArrayLike | None = None,
    velocity: ArrayLike = (0.0, 0.0, 0.0),
) -> Obstacle:
    """Return a solid cylinder with flat ends; its axis is the third column of `rotation`. Raises as `box`."""
    return _placed(name, "cylinder", center, rotation, np.array([radius, 0.5 * height]), velocity)


def mesh(
    name: str,
    source: str | PathLike[str] | tuple[ArrayLike, ArrayLike],
    center: ArrayLike = (0.0, 0.0, 0.0),
    rotation: ArrayLike | None = None,
    scale: float = 1.0,
    velocity: ArrayLike = (0.0, 0.0, 0.0),
) -> Obstacle:
    """Return a triangle mesh, convex or not.

    A watertight mesh is solid: a body inside it has a negative clearance. An open one is a sheet.

    Parameters
    ----------
    source : path or (vertices (K, 3), triangles (T, 3))
        STL, OBJ, PLY or OFF file, or the arrays, m.
    center, rotation, scale
        Placement: ``center + rotation @ (scale * vertex)``.

    Raises
    ------
    GeometryError
        The file is missing or cannot be read, it holds no triangle, a number is wrong, or the triangles of a closed
        mesh are not wound alike.
    """
    import trimesh

    if isinstance(source, tuple):
        vertices, triangles = np.asarray(source[0], dtype=float), np.asarray(source[1], dtype=np.int64)
        surface = trimesh.Trimesh(vertices, triangles, process=True)
    else:
        path = Path(source)
        if path.suffix.lower() not in _MESH_FORMATS:
            raise GeometryError(f'obstacle "{name}": {path.name} is not one of {", ".join(_MESH_FORMATS)}')
        try:
            surface = trimesh.load_mesh(path)
            found = np.asarray(surface.triangles, dtype=float)
        except Exception as error:  # a reader of foreign files raises anything
            raise GeometryError(f'obstacle "{name}": cannot read {path}: {error}') from None
        if len(found) and found.shape[1:] != (3, 3):
            raise GeometryError(f'obstacle "{name}": {path} holds other faces than triangles in space')
    if len(surface.faces) == 0:
        raise GeometryError(f'obstacle "{name}": the mesh holds no triangle')
    if not np.abs(surface.triangles).max() <= GREATEST_LENGTH:
        raise GeometryError(
            f'obstacle "{name}": the mesh holds a coordinate beyond {GREATEST_LENGTH:g} or none'
        )
    solid = bool(surface.is_watertight)
    if solid:
        if not surface.is_winding_consistent:
            raise GeometryError(
                f'obstacle "{name}": neighbours among its triangles are not wound alike, which leaves open what is '
                "inside; expected corners counter-clockwise seen from outside"
            )
        surface.fix_normals()
    turn = _rotation(name, rotation)
    corners = _positive(name, np.array([scale]))[0] * np.asarray(surface.triangles, dtype=float)
    corners = corners @ turn.T + _vector(name, "center", center)
    pieces = np.zeros((len(corners), WIDTH))
    pieces[:, :9] = corners.reshape(-1, 9)
    return Obstacle(name, "triangle", pieces, _vector(name, "velocity", velocity), solid)


def _placed(
    name: str, shape: str, center: ArrayLike, rotation: ArrayLike | None, sizes: Array, velocity: ArrayLike
) -> Obstacle:
    piece = np.zeros((1, WIDTH))
    piece[0, :3] = _vector(name, "center", center)
    piece[0, 3:12] = _rotation(name, rotation).ravel()
    piece[0, 12 : 12 + len(sizes)] = _positive(name, sizes)
    return Obstacle(name, shape, piece, _vector(name, "velocity", velocity))


def _vector(name: str, what: str, values: ArrayLike) -> Array:
    vector = np.array(values, dtype=float)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise GeometryError(f'obstacle "{name}": {what} must be three finite numbers, not {values!r}')
    return vector


def _positive(name: str, sizes: Array) -> Array:
    if not (np.isfinite(sizes).all() and (sizes > 0.0).all()):
        raise GeometryError(f'obstacle "{name}": sizes must be positive, not {sizes.tolist()}')
    return sizes


def _rotation(name: str, rotation: ArrayLike | None) -> Array:
    if rotation is None:
        return np.eye(3)
    turn = np.array(rotation, dtype=float)
    if (
        turn.shape != (3, 3)
        or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-9)
        or np.linalg.det(turn) < 0
    ):
        raise GeometryError(f'obstacle "{name}": rotation must be a right-handed orthonormal 3 x 3 matrix')
    return turn


class ObstaclePieces:
    """All pieces of a list of obstacles, side by side.

    Attributes
    ----------
    parameters, center, radius : (P, 15), (P, 3), (P,)
        At time 0, with their bounding spheres, m.
    shape, obstacle : (P,) str, (P,) int
        The latter is the index of the obstacle each belongs to.
    velocity, speed, fastest : (P, 3), (P,), float
        m/s; the last one is the greatest speed.
    allowance : (P,)
        That of the obstacle, m.
    """

    def __init__(self, obstacles: Sequence[Obstacle]) -> None:
        counts = [len(o.pieces) for o in obstacles]
        self.parameters = np.vstack([np.zeros((0, WIDTH)), *(o.pieces for o in obstacles)])
        self.shape = np.repeat([o.shape for o in obstacles] or [""], counts or [0])
        self.obstacle = np.repeat(np.arange(len(obstacles)), counts)
        self.velocity = np.repeat(np.reshape([o.velocity for o in obstacles], (-1, 3)), counts, axis=0)
        self.allowance = np.repeat([o.allowance for o in obstacles] or [0.0], counts or [0])
        self.speed = np.asarray(np.linalg.norm(self.velocity, axis=1))
        self.fastest = float(self.speed.max(initial=0.0))
        self.moving = self.fastest > 0.0
        triangles = self.shape == "triangle"
        corners = self.parameters[triangles, :9].reshape(-1, 3, 3)
        self.center, self.radius = (
            self.parameters[:, :3].copy(),
            np.linalg.norm(self.parameters[:, 12:], axis=1),
        )
        self.center[triangles] = corners.mean(axis=1)
        spread = np.linalg.norm(corners - self.center[triangles, None], axis=2)
        self.radius[triangles] = spread.max(axis=1, initial=0.0)
        self._shift = np.zeros_like(self.parameters)
        self._shift[:, :3] = self.velocity
        self._shift[triangles, :9] = np.tile(self.velocity[triangles], 3)
        self._now: tuple[float, Array] = (0.0, self.parameters)

    def __len__(self) -> int:
        return len(self.parameters)

    def at(self, time: float) -> Array:
        """Return the parameters (P, 15) at `time`; do not write into them."""
        if not self.moving:
            return self.parameters
        if self._now[0] != time:
            self._now = (time, self.parameters + time * self._shift)
        return self._now[1]
