"""Frames on paper: what is in front is drawn last, nothing is distorted, every format is written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from figures import clipped_and_overlapping
from hypothesis import given, settings
from hypothesis import strategies as st

import vgtm_qp as vq
from vgtm_qp.errors import VgtmError
from vgtm_qp.view.drawing import ObstacleMesh, drawing_of_maneuver
from vgtm_qp.view.figure import View, plot_frames, save_figure
from vgtm_qp.view.projection import ProjectedMesh, Projection, layers, pieces

angles = st.floats(-3.0, 3.0)


@pytest.fixture(scope="module")
def maneuver() -> vq.Maneuver:
    problem = vq.load_problem("five_bay_two_cubes")
    return vq.solve(problem.replace({"maneuver.steps": 12}), verify=False)


def surface(
    mesh: trimesh.Trimesh, projection: Projection, center: tuple[float, float, float]
) -> ProjectedMesh:
    zero = np.zeros(3)
    return ProjectedMesh(
        ObstacleMesh("body", np.asarray(mesh.vertices), np.asarray(mesh.faces), np.array(center), zero),
        projection,
    )


@given(angles, st.floats(-1.4, 1.4))
@settings(max_examples=30, deadline=None)
def test_a_projection_is_a_right_handed_rotation_with_z_up(azimuth: float, elevation: float):
    axes = Projection(azimuth, elevation).axes
    assert np.allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.isclose(np.linalg.det(axes), 1.0)
    assert abs(axes[0, 2]) < 1e-12
    assert axes[1, 2] > 0.0


@given(angles, st.floats(-1.2, 1.2), st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3))
@settings(max_examples=80, deadline=None)
def test_a_point_is_before_a_box_where_its_line_of_sight_says_so(azimuth, elevation, place):
    projection = Projection(azimuth, elevation)
    center, half = np.array([0.3, -0.2, 0.5]), np.array([0.5, 0.4, 0.6])
    body = surface(trimesh.creation.box(extents=2 * half), projection, tuple(center))
    point = np.array(place)
    ray = projection.axes[2]
    if np.abs(ray).min() < 1e-6:
        return
    crossings = np.sort(np.stack([(center - half - point) / ray, (center + half - point) / ray]), axis=0)
    enters, leaves = crossings[0].max(), crossings[1].min()
    if leaves - enters < 1e-6 or min(abs(enters), abs(leaves)) < 1e-6:
        return
    # The line towards the viewer leaves the box ahead of the point: the box hides the point.
    assert body.is_before(point[None], 0.0)[0] == (leaves < 0.0)


def test_layers_count_the_surfaces_behind_a_point():
    projection = Projection(0.0, 0.0)
    boxes = [surface(trimesh.creation.box(extents=(1, 1, 1)), projection, (x, 0.0, 0.0)) for x in (-3.0, 3.0)]
    points = np.array([[-5.0, 0.0, 0.0], [0.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    assert layers(points, boxes, 0.0).tolist() == [0, 1, 2]


def test_a_moving_obstacle_is_where_it_is_at_the_time():
    projection = Projection(0.0, 0.0)
    box = trimesh.creation.box(extents=(1, 1, 1))
    body = ProjectedMesh(
        ObstacleMesh(
            "body", np.asarray(box.vertices), np.asarray(box.faces), np.zeros(3), np.array([1.0, 2.0, 0.0])
        ),
        projection,
    )
    assert body.depth(3.0) == pytest.approx(3.0)
    assert body.polygons(3.0)[0].mean(axis=0) == pytest.approx([6.0, 0.0])


def test_a_body_with_a_hollow_is_not_convex():
    ring = trimesh.creation.annulus(0.5, 1.0, 0.3)
    assert not surface(ring, Projection(0.3, 0.4), (0.0, 0.0, 0.0)).is_convex
    assert surface(trimesh.creation.icosphere(), Projection(0.3, 0.4), (0.0, 0.0, 0.0)).is_convex


def test_pieces_cover_a_member_and_nothing_beyond_it():
    ends = np.array([[[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]])
    cut = pieces(ends, 5)
    assert cut.shape == (5, 2, 3)
    assert np.allclose(cut[0, 0], ends[0, 0])
    assert np.allclose(cut[-1, 1], ends[0, 1])
    assert np.all(cut[:-1, 1] >= cut[1:, 0])


def test_panels_have_one_scale_and_hold_the_arm(maneuver: vq.Maneuver):
    figure = plot_frames(maneuver, frames=5, azimuth=-1.0, elevation=0.3)
    panels = figure.axes[:5]
    width, height = figure.get_size_inches()
    projection = Projection(-1.0, 0.3)
    arm = projection.flat(maneuver.nodes)
    for axes in panels:
        (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
        box = axes.get_position()
        assert box.width * width / (right - left) == pytest.approx(box.height * height / (high - low))
        assert left < arm[..., 0].min()
        assert arm[..., 0].max() < right
        assert low < arm[..., 1].min()
        assert arm[..., 1].max() < high
    assert panels[0].get_title() == "(a) step 0, 0 s"


def test_a_figure_shows_units_and_the_range_of_lengths(maneuver: vq.Maneuver):
    figure = plot_frames(maneuver)
    words = {text.get_text() for axes in figure.axes for text in axes.texts}
    assert {"x (m)", "y (m)", "z (m)"} <= words
    bar = figure.axes[-1]
    assert bar.get_xlabel() == "length of actuated members (m)"
    assert bar.get_xlim() == pytest.approx(
        tuple(drawing_of_maneuver(maneuver).arm.stroke[maneuver.member_actuated][0])
    )


@pytest.mark.parametrize("azimuth", [None, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0])
def test_no_words_of_a_figure_are_clipped_or_lie_upon_others(maneuver: vq.Maneuver, azimuth: float | None):
    clipped, upon = clipped_and_overlapping(plot_frames(maneuver, frames=2, azimuth=azimuth))
    assert not clipped
    assert not upon


@pytest.mark.parametrize(("suffix", "start"), [(".pdf", b"%PDF"), (".png", b"\x89PNG"), (".svg", b"<?xml")])
def test_every_format_is_written_whole(maneuver: vq.Maneuver, tmp_path: Path, suffix: str, start: bytes):
    path = save_figure(maneuver.plot(frames=2), tmp_path / "new folder" / f"frames{suffix}")
    assert path.read_bytes().startswith(start)
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_what_cannot_be_drawn_is_named(maneuver: vq.Maneuver, tmp_path: Path):
    figure = plot_frames(maneuver, frames=[0])
    with pytest.raises(VgtmError, match=r"\.pdf, \.png, \.svg"):
        save_figure(figure, tmp_path / "frames.gif")
    (tmp_path / "file").write_text("")
    with pytest.raises(VgtmError, match="cannot be written"):
        save_figure(figure, tmp_path / "file" / "frames.png")
    last = len(maneuver.time) - 1
    with pytest.raises(VgtmError, match=f"0 to {last}"):
        plot_frames(maneuver, frames=[last + 1])
    with pytest.raises(VgtmError, match="1 or more"):
        plot_frames(maneuver, frames=0)


def test_a_serial_arm_is_drawn_as_its_capsules_and_whole():
    problem = vq.load_problem("station_arm_past_a_module").replace({"maneuver.steps": 6})
    result = vq.solve(problem, verify=False)
    view, arm = View(result, [0, len(result.time) - 1]), drawing_of_maneuver(result).arm
    for row in (0, -1):
        ends = view.projection.flat(arm.ends(result.nodes[row]))
        assert (ends.min(axis=1) - arm.radius[:, None] >= view.low - 1e-9).all()
        assert (ends.max(axis=1) + arm.radius[:, None] <= view.high + 1e-9).all()
    clipped, overlapping = clipped_and_overlapping(plot_frames(result, frames=2))
    assert not clipped
    assert not overlapping
