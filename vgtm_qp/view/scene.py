"""The arm in a viser scene: solid members, nodes, curve, control polygon, obstacles and paths."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array
from vgtm_qp.errors import MissingExtraError
from vgtm_qp.rotation import quaternion
from vgtm_qp.view.drawing import (
    CURVE_COLOUR,
    FIXED_COLOUR,
    PATH_COLOUR,
    POLYGON_COLOUR,
    Camera,
    Drawing,
    DrawnHull,
    ObstacleMesh,
)
from vgtm_qp.view.links import LinkScene

_FIXED_POINT = 2.0**-12
"""Resolution of recorded coordinates, m: a quarter of a millimetre, so that a recording compresses."""


MARK_COLOUR = (0.92, 0.0, 0.72)
"""What holds the arm back: bodies, obstacles and the line between them."""


@dataclass(eq=False)
class _DrawnObstacle:
    """An obstacle, and its handles in the scene."""

    mesh: ObstacleMesh
    frame: Any
    surface: Any

    def place(self, time: float) -> None:
        """Put it where it is at `time`, s."""
        self.frame.position = self.mesh.position(time)
        self.frame.wxyz = quaternion(self.mesh.rotation(time))


def import_viser() -> Any:
    """Return the module ``viser``; raise MissingExtraError if it is not installed."""
    try:
        import viser
    except ImportError:
        raise MissingExtraError("view", "viser") from None
    return viser


class ArmScene:
    """Draws one arm into a viser scene once, and moves it afterwards.

    Attributes
    ----------
    unit : float
        The size of the arm's parts, m.
    ball : float
        Radius of a ball that stands out at the arm, m.
    painted : (M, 3) or None
        Colours of the bodies from the next `move` on, 0 to 1; by default those of ``Drawing.colours``.
    links : LinkScene or None
        The links as a URDF file draws them.
    """

    painted: Array | None = None
    links: LinkScene | None = None

    def __init__(self, server: Any, drawing: Drawing, nodes: Array, control_vertices: Array) -> None:
        import trimesh

        self._server, self._scene, self._drawing = server, server.scene, drawing
        arm, self.unit = drawing.arm, float(drawing.arm.size)
        self.ball = max((0.3 if drawing.hulls else 0.085) * self.unit, 1.8 * float(np.median(arm.radius)))
        self._scene.set_up_direction("+z")
        self._scene.world_axes.visible = False
        self._add_ground(nodes)
        tube = trimesh.creation.cylinder(radius=1.0, height=1.0, sections=16)
        position, wxyz, span = _placement(arm.ends(nodes))
        scales = np.column_stack([arm.radius, arm.radius, span]).astype(np.float32)
        colours = drawing.colours(arm.lengths(nodes))
        self._members = []
        for name, which in (("fixed", ~arm.stretches & ~arm.is_hull), ("actuated", arm.stretches)):
            if which.any():
                placed = position[which], wxyz[which], colours[which]
                handle = self._add_many(f"/members/{name}", tube, *placed, batched_scales=scales[which])
                self._members.append((which, handle))
        # Hulls hide the balls at their joints.
        radius = (
            1.35 * float(np.median(arm.radius[~arm.is_hull])) if not arm.is_hull.all() else 0.02 * self.unit
        )
        ball = trimesh.creation.icosphere(subdivisions=2, radius=radius)
        unturned = np.tile([1.0, 0.0, 0.0, 0.0], (len(drawing.marks), 1))
        dark = tuple(0.55 * channel for channel in FIXED_COLOUR)
        self._nodes = self._add_many("/nodes", ball, nodes[drawing.marks], unturned, dark)
        self._hulls = [(hull, self._add_hull(hull, nodes)) for hull in drawing.hulls]
        self._curve = self._polygon = self._vertices = None
        if drawing.curve_weights.size:
            points = drawing.curve(control_vertices)
            self._curve = self.add_path("/curve", points, colour=CURVE_COLOUR, thickness=0.028)
            style: Any = {"colour": POLYGON_COLOUR, "thickness": 0.01}
            self._polygon = self.add_path("/control polygon", control_vertices, **style)
            self._vertices = self._scene.add_point_cloud(
                "/control vertices",
                control_vertices.astype(np.float32),
                _rgb(POLYGON_COLOUR),
                point_size=0.05,
                point_shape="circle",
            )
        self._marked: list[int] = []
        self._line: Any = None
        self._said: Any = None
        self._obstacles = {_path(mesh): self._add_obstacle(mesh) for mesh in drawing.obstacles}
        if surfaces := drawing.links():
            self.links = LinkScene(self._scene, arm, surfaces)
            self.ball = min(self.ball, 0.3 * self.unit)
            self.show(links=True, bodies=False)

    def show(self, *, links: bool, bodies: bool) -> None:
        """Show the links that a URDF file draws, the bodies that are kept clear, or both; without links the bodies."""
        if self.links is not None:
            self.links.show(links)
        drawn = [handle for _, handle in (*self._members, *self._hulls)]
        for handle in (*drawn, self._nodes):
            handle.visible = bodies or self.links is None
            handle.opacity = 0.3 if links and self.links is not None else None

    def move(
        self,
        nodes: Array,
        control_vertices: Array,
        time: float,
        *,
        q: Array | None = None,
        coarse: bool = False,
    ) -> None:
        """Show the arm at `nodes` (N, 3) and `control_vertices` (V, 3), m, and obstacles at `time`, s.

        Links that a URDF file draws are put where they are at the configuration `q`. With `coarse` coordinates are
        rounded to a quarter of a millimetre.
        """

        def numbers(array: Array) -> NDArray[np.float32]:
            rounded = np.round(array / _FIXED_POINT) * _FIXED_POINT if coarse else array
            return np.asarray(rounded, dtype=np.float32)

        arm = self._drawing.arm
        position, wxyz, span = map(numbers, _placement(arm.ends(nodes)))
        shown = self._drawing.colours(arm.lengths(nodes)) if self.painted is None else self.painted.copy()
        shown[self._marked] = MARK_COLOUR
        colours = _instance_rgb(shown)
        with self._server.atomic():
            for which, handle in self._members:
                handle.batched_positions = position[which]
                handle.batched_wxyzs = wxyz[which]
                if arm.stretches[which].any():
                    scales = np.array(handle.batched_scales)
                    scales[:, 2] = span[which]
                    handle.batched_scales = scales
                if not np.array_equal(handle.batched_colors, colours[which]):
                    handle.batched_colors = colours[which]
            for hull, surface in self._hulls:
                at, turn = hull.pose(nodes)
                surface.position, surface.wxyz = numbers(at), numbers(quaternion(turn))
                if tuple(surface.color) != (colour := tuple(_rgb(shown[hull.body]).tolist())):
                    surface.color = colour
            self._nodes.batched_positions = numbers(nodes[self._drawing.marks])
            if self.links is not None and q is not None:
                self.links.move(q, _FIXED_POINT if coarse else 0.0)
            if self._curve is not None and self._polygon is not None and self._vertices is not None:
                self._curve.points = numbers(_segments(self._drawing.curve(control_vertices)))
                self._polygon.points = numbers(_segments(control_vertices))
                self._vertices.points = numbers(control_vertices)
            is_changing = any(np.isfinite((mesh.since, mesh.until)).any() for mesh in self._drawing.obstacles)
            for drawn in self._obstacles.values():
                if is_changing:
                    drawn.frame.visible = drawn.mesh.is_there(time)
                if drawn.mesh.moves and drawn.mesh.is_there(time):
                    drawn.place(time)

    def put(self, obstacles: Sequence[ObstacleMesh], time: float) -> None:
        """Show `obstacles` in the place of those that were there, where they are at `time`, s."""
        wanted = {_path(mesh): mesh for mesh in obstacles}
        with self._server.atomic():
            for path in [path for path in self._obstacles if path not in wanted]:
                self._obstacles.pop(path).frame.remove()
            for path, mesh in wanted.items():
                drawn = self._obstacles.get(path)
                if drawn is None:
                    drawn = self._obstacles[path] = self._add_obstacle(mesh)
                elif drawn.mesh.vertices is not mesh.vertices:
                    # Faces and vertices go together: another shape may have taken the name.
                    drawn.surface.vertices = mesh.vertices.astype(np.float32)
                    drawn.surface.faces = mesh.faces.astype(np.uint32)
                drawn.mesh, drawn.surface.color = mesh, tuple(_rgb(mesh.colour).tolist())
                drawn.place(time)

    def mark(self, bodies: Sequence[int], obstacles: Collection[str], line: Array | None, said: str) -> None:
        """Show bodies, by index, with the next `move`, and obstacles, by name, as what holds the arm; so the `line`.

        Its two points (2, 3), m, are those where a body and an obstacle are nearest, and have the label `said`; None
        for no line.
        """
        self._marked = [body for body in bodies if body < len(self._drawing.arm.radius)]
        for drawn in self._obstacles.values():
            colour = MARK_COLOUR if drawn.mesh.name in obstacles else drawn.mesh.colour
            if tuple(drawn.surface.color) != tuple(_rgb(colour)):
                drawn.surface.color = tuple(_rgb(colour).tolist())
        if self._line is None and line is not None:
            self._line = self.add_path("/hold", line, colour=MARK_COLOUR, thickness=0.03 * self.unit)
            self._said = self._scene.add_label("/hold label", said, anchor="bottom-center")
        if self._line is not None:
            self._line.visible = self._said.visible = line is not None
        if self._line is not None and line is not None:
            self._line.points = _segments(line).astype(np.float32)
            self._said.position, self._said.text = line[1], said

    def add_path(
        self, name: str, points: Array, *, colour: Any = PATH_COLOUR, thickness: float = 0.012
    ) -> Any:
        """Draw a line through `points` (K, 3), m, and return its handle."""
        segments = _segments(points).astype(np.float32)
        return self._scene.add_line_segments(name, segments, _rgb(colour), thickness=thickness)

    def look(self, camera: Camera) -> None:
        """Let every new page begin with `camera`."""
        first = self._server.initial_camera
        first.position, first.look_at, first.fov = camera.position, camera.target, camera.field_of_view

    def _add_many(
        self, name: str, shape: Any, position: Array, wxyz: Array, colours: Any, **more: Any
    ) -> Any:
        """Draw the mesh `shape` at each position (K, 3), m, turned by quaternions (K, 4)."""
        return self._scene.add_batched_meshes_simple(
            name,
            shape.vertices,
            shape.faces,
            batched_positions=position,
            batched_wxyzs=wxyz,
            batched_colors=_instance_rgb(colours),
            lod="off",
            **more,
        )

    def _add_hull(self, hull: DrawnHull, nodes: Array) -> Any:
        position, rotation = hull.pose(nodes)
        return self._scene.add_mesh_simple(
            f"/members/{self._drawing.arm.member_names[hull.body]}",
            hull.vertices.astype(np.float32),
            hull.faces.astype(np.uint32),
            color=_rgb(FIXED_COLOUR),
            flat_shading=True,
            position=position,
            wxyz=quaternion(rotation),
        )

    def _add_obstacle(self, mesh: ObstacleMesh) -> _DrawnObstacle:
        path = _path(mesh)
        frame = self._scene.add_frame(path, show_axes=False)
        surface = self._scene.add_mesh_simple(
            f"{path}/surface",
            mesh.vertices.astype(np.float32),
            mesh.faces.astype(np.uint32),
            color=_rgb(mesh.colour),
            opacity=0.45,
            flat_shading=True,
            side="double",
            cast_shadow=False,
        )
        self._scene.add_label(f"{path}/name", mesh.name, anchor="center-center")
        drawn = _DrawnObstacle(mesh, frame, surface)
        drawn.place(max(mesh.since, 0.0))
        return drawn

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


def _path(mesh: ObstacleMesh) -> str:
    """Return where an obstacle is in the scene; one that was moved is drawn once for each place."""
    return f"/obstacles/{mesh.name}" + (f" from {mesh.since!r} s" if np.isfinite(mesh.since) else "")


def _placement(ends: Array) -> tuple[Array, Array, Array]:
    """Return middles (K, 3), quaternions (K, 4) that turn z along, spans (K,), of the first two ends (K, V, 3), m."""
    ends = ends[:, :2]
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
    """Return colours for batched meshes, which the renderer takes as linear light; all others are sRGB."""
    colours = np.asarray(colours)
    return _rgb(np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4))
