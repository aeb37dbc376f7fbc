"""The arm in a viser scene: solid members, nodes, curve, control polygon, obstacles and paths."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import MissingExtraError
from vgtm_qp.view.drawing import (
    CURVE_COLOUR,
    FIXED_COLOUR,
    OBSTACLE_COLOUR,
    PATH_COLOUR,
    POLYGON_COLOUR,
    Camera,
    Drawing,
)

Array = NDArray[np.float64]

_FIXED_POINT = 2.0**-12
"""Resolution of recorded coordinates, m: a quarter of a millimetre, so that a recording compresses."""


def import_viser() -> Any:
    """Return the module ``viser``.

    Raises
    ------
    MissingExtraError
        It is not installed.
    """
    try:
        import viser
    except ImportError:
        raise MissingExtraError("view", "viser") from None
    return viser


@contextmanager
def viser_server(port: int = 0) -> Iterator[Any]:
    """Run a viser server that this machine alone can reach; its own messages do not reach stdout.

    Raises
    ------
    MissingExtraError
        viser is not installed.
    """
    viser = import_viser()
    with redirect_stdout(StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
    try:
        yield server
    finally:
        with redirect_stdout(StringIO()):
            server.stop()


class ArmScene:
    """Draws one arm into a viser scene once, and moves it as often as asked."""

    def __init__(self, server: Any, drawing: Drawing, nodes: Array, control_vertices: Array) -> None:
        self._server, self._scene, self._drawing = server, server.scene, drawing
        arm = drawing.arm
        self._scene.set_up_direction("+z")
        self._scene.world_axes.visible = False
        self._add_ground(nodes)
        ends, lengths = drawing.ends(nodes), arm.lengths(nodes)
        self._groups = [
            (index, self._add_members(name, ends[index], arm.radius[index], drawing.colours(lengths)[index]))
            for name, index in (
                ("fixed", np.flatnonzero(~arm.stretches)),
                ("actuated", np.flatnonzero(arm.stretches)),
            )
            if len(index)
        ]
        self._nodes = self._add_nodes(nodes)
        self._curve = self._polygon = self._vertices = None
        if drawing.curve_weights.size:
            self._curve = self._add_line("/curve", drawing.curve(control_vertices), CURVE_COLOUR, 0.028)
            self._polygon = self._add_line("/control polygon", control_vertices, POLYGON_COLOUR, 0.01)
            self._vertices = self._scene.add_point_cloud(
                "/control vertices",
                control_vertices.astype(np.float32),
                _rgb(POLYGON_COLOUR),
                point_size=0.05,
                point_shape="circle",
            )
        self._obstacles = [self._add_obstacle(mesh) for mesh in drawing.obstacles]

    def move(self, nodes: Array, control_vertices: Array, time: float, *, coarse: bool = False) -> None:
        """Show the arm at `nodes` (N, 3) and `control_vertices` (V, 3), m, and obstacles at `time`, s.

        With `coarse` coordinates are rounded to a quarter of a millimetre.
        """

        def numbers(array: Array) -> NDArray[np.float32]:
            rounded = np.round(array / _FIXED_POINT) * _FIXED_POINT if coarse else array
            return np.asarray(rounded, dtype=np.float32)

        ends, lengths = self._drawing.ends(nodes), self._drawing.arm.lengths(nodes)
        colours = self._drawing.colours(lengths)
        with self._server.atomic():
            for index, handle in self._groups:
                position, wxyz, span = _placement(ends[index])
                handle.batched_positions = numbers(position)
                handle.batched_wxyzs = numbers(wxyz)
                if self._drawing.arm.stretches[index].any():
                    scales = np.array(handle.batched_scales)
                    scales[:, 2] = numbers(span)
                    handle.batched_scales = scales
                    handle.batched_colors = _instance_rgb(colours[index])
            self._nodes.batched_positions = numbers(nodes)
            if self._curve is not None and self._polygon is not None and self._vertices is not None:
                self._curve.points = numbers(_segments(self._drawing.curve(control_vertices)))
                self._polygon.points = numbers(_segments(control_vertices))
                self._vertices.points = numbers(control_vertices)
            for mesh, handle in zip(self._drawing.obstacles, self._obstacles, strict=True):
                if mesh.velocity.any():
                    handle.position = mesh.position(time)

    def add_path(self, name: str, points: Array, *, thickness: float = 0.012) -> Any:
        """Draw a line through `points` (K, 3), m, and return its handle."""
        return self._add_line(name, points, PATH_COLOUR, thickness)

    def look(self, camera: Camera) -> None:
        """Let every new page begin with `camera`."""
        first = self._server.initial_camera
        first.position, first.look_at, first.fov = camera.position, camera.target, camera.field_of_view

    def _add_members(self, name: str, ends: Array, radius: Array, colours: Array) -> Any:
        import trimesh

        tube = trimesh.creation.cylinder(radius=1.0, height=1.0, sections=16)
        position, wxyz, span = _placement(ends)
        return self._scene.add_batched_meshes_simple(
            f"/members/{name}",
            tube.vertices,
            tube.faces,
            batched_wxyzs=wxyz,
            batched_positions=position,
            batched_scales=np.column_stack([radius, radius, span]).astype(np.float32),
            batched_colors=_instance_rgb(colours),
            lod="off",
            flat_shading=False,
        )

    def _add_nodes(self, nodes: Array) -> Any:
        import trimesh

        ball = trimesh.creation.icosphere(
            subdivisions=2, radius=1.35 * float(np.median(self._drawing.arm.radius))
        )
        return self._scene.add_batched_meshes_simple(
            "/nodes",
            ball.vertices,
            ball.faces,
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(nodes), 1)),
            batched_positions=nodes,
            batched_colors=_instance_rgb(tuple(0.55 * channel for channel in FIXED_COLOUR)),
            lod="off",
        )

    def _add_line(
        self, name: str, points: Array, colour: tuple[float, float, float], thickness: float
    ) -> Any:
        return self._scene.add_line_segments(
            name, _segments(points).astype(np.float32), _rgb(colour), thickness=thickness
        )

    def _add_obstacle(self, mesh: Any) -> Any:
        group = self._scene.add_frame(f"/obstacles/{mesh.name}", show_axes=False, position=mesh.center)
        self._scene.add_mesh_simple(
            f"/obstacles/{mesh.name}/surface",
            mesh.vertices.astype(np.float32),
            mesh.faces.astype(np.uint32),
            color=_rgb(OBSTACLE_COLOUR),
            opacity=0.45,
            flat_shading=True,
            side="double",
            cast_shadow=False,
        )
        self._scene.add_label(f"/obstacles/{mesh.name}/name", mesh.name, anchor="center-center")
        return group

    def _add_ground(self, nodes: Array) -> None:
        base = nodes[self._drawing.arm.base]
        side = 2.0 * float(np.ceil(np.ptp(nodes, axis=0).max()))
        self._scene.add_grid(
            "/ground",
            width=side,
            height=side,
            plane="xy",
            cell_size=0.5,
            section_size=1.0,
            cell_color=(225, 227, 230),
            section_color=(198, 202, 208),
            position=(0.0, 0.0, float(base[:, 2].min()) - 0.002),
        )


def _placement(ends: Array) -> tuple[Array, Array, Array]:
    """Return middles (K, 3), quaternions (K, 4) that turn z along, spans (K,), of segments (K, 2, 3), m."""
    along = ends[:, 1] - ends[:, 0]
    span = np.linalg.norm(along, axis=1)
    direction = along / np.maximum(span, 1e-12)[:, None]
    direction = np.where(direction[:, 2:] < 0.0, -direction, direction)
    w = np.sqrt((1.0 + direction[:, 2]) / 2.0)
    wxyz = np.column_stack([w, -direction[:, 1] / (2.0 * w), direction[:, 0] / (2.0 * w), np.zeros(len(w))])
    return ends.mean(axis=1), wxyz, span


def _segments(points: Array) -> Array:
    return np.stack([points[:-1], points[1:]], axis=1)


def _rgb(colours: Any) -> NDArray[np.uint8]:
    return np.asarray(np.round(255.0 * np.asarray(colours)), dtype=np.uint8)


def _instance_rgb(colours: Any) -> NDArray[np.uint8]:
    """Return colours for batched meshes: the renderer takes those as linear light, all others as sRGB."""
    colours = np.asarray(colours)
    return _rgb(np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4))
