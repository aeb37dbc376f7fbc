"""Plots show the numbers of the result, with units, and what may not be entered."""

from __future__ import annotations

import numpy as np
import pytest
from figures import clipped_and_overlapping
from matplotlib.figure import Figure
from synthetic import maneuver_of, place, tripod

import vgtm_qp as vq
from vgtm_qp.view.drawing import camera_for, drawing_of_maneuver, off_curve, resampled, stroke_colours


@pytest.fixture(scope="module")
def maneuver() -> vq.Maneuver:
    time = np.array([0.0, 0.5, 1.0, 1.5])
    legs = 1.4 + 0.05 * time
    nodes = np.array([place(np.array([leg, 1.4, 1.4, 1.5, 1.5, 0.9 + 0.1 * leg])) for leg in legs])
    return maneuver_of(
        nodes, time, tripod(), clearance=np.array([0.3, 0.2, 0.1, 0.15]), self_clearance=np.full(4, 0.4)
    )


@pytest.mark.smoke
def test_clearance_is_drawn_in_millimetres_above_what_is_forbidden(maneuver: vq.Maneuver):
    (axes,) = maneuver.plot_clearance().axes
    lines = {line.get_label(): line for line in axes.lines}
    assert np.allclose(lines["to obstacles"].get_ydata(), 1000.0 * maneuver.clearance)
    assert np.allclose(lines["between members"].get_ydata(), 1000.0 * maneuver.self_clearance)
    assert axes.get_ylabel() == "least clearance (mm)"
    safe = 1000.0 * maneuver.manifest["problem"]["clearance"]["safe"]
    assert max(patch.get_extents().transformed(axes.transData.inverted()).y1 for patch in axes.patches) == (
        pytest.approx(safe)
    )


@pytest.mark.smoke
def test_the_legend_of_clearances_lies_above_the_plot(maneuver: vq.Maneuver):
    figure = maneuver.plot_clearance()
    assert clipped_and_overlapping(figure) == ([], [])
    (axes,) = figure.axes
    assert axes.get_legend().get_window_extent().y0 >= axes.get_window_extent().y1
    least = {line.get_label(): line.get_ydata()[0] for line in axes.lines}
    assert 1000.0 * maneuver.manifest["problem"]["clearance"]["safe"] * 0.25 in least.values()


@pytest.mark.smoke
def test_strokes_are_drawn_between_their_limits(maneuver: vq.Maneuver):
    (axes,) = maneuver.plot_strokes().axes
    lines = {line.get_label(): line for line in axes.lines}
    assert np.allclose(lines["leg-1"].get_ydata(), maneuver.member_lengths[:, 0])
    assert np.allclose(lines["mast-3"].get_ydata(), maneuver.member_lengths[:, 5])
    low, high = axes.get_ylim()
    assert low < 0.7 < 1.8 < high
    assert len(axes.patches) == 2


@pytest.mark.smoke
def test_tip_error_and_step_time_are_those_of_the_result(maneuver: vq.Maneuver):
    (axes,) = maneuver.plot_tip_error().axes
    assert axes.get_yscale() == "log"
    assert axes.lines[0].get_ydata().max() <= 1e-17
    (axes,) = maneuver.plot_step_time().axes
    steps = maneuver.steps
    tops = np.zeros(steps)
    for container in axes.containers:
        tops = np.maximum(tops, [bar.get_y() + bar.get_height() for bar in container])
    assert np.allclose(tops, 1000.0 * maneuver.step_time[1:])


def test_gaps_to_the_curve_are_shown_in_plot_frames_and_page():
    problem = vq.load_problem("five_bay_two_cubes_pointing").replace(
        {"method.tracking_mode": "elastic", "maneuver.steps": 6, "method.retries": False}
    )
    maneuver = vq.solve(problem)
    gap, where = maneuver.certificate.tracking_gap.value, maneuver.certificate.tracking_gap.where
    (axes,) = maneuver.plot_tracking_gap().axes
    shown = axes.lines[0].get_ydata()
    assert shown[1:].max() == pytest.approx(gap, rel=1e-12)
    assert f"row {int(np.argmax(shown))}," in where
    titles = [axes.get_title() for axes in maneuver.plot(frames=[0, int(np.argmax(shown))]).axes[:2]]
    assert "off the curve" not in titles[0]
    assert titles[1].endswith(f"\n{1000.0 * gap:.3g} mm off the curve")
    assert off_curve(maneuver)[int(np.argmax(shown))] == f"{1000.0 * gap:.3g} mm off the curve"
    (axes,) = vq.solve(problem.replace({"method": {"tracking": "none"}})).plot_tracking_gap().axes
    assert len(axes.lines) == 1


@pytest.mark.smoke
def test_plots_share_a_figure_where_axes_are_given(maneuver: vq.Maneuver):
    figure = Figure()
    grid = figure.subplots(2, 2)
    plots = (maneuver.plot_clearance, maneuver.plot_strokes, maneuver.plot_tip_error, maneuver.plot_step_time)
    for plot, axes in zip(plots, grid.ravel(), strict=True):
        assert plot(axes=axes) is figure
        assert axes.get_xlabel()
        assert "(" in axes.get_ylabel()


@pytest.mark.smoke
def test_a_home_pose_alone_can_be_plotted(maneuver: vq.Maneuver):
    nodes = maneuver.nodes[:1]
    alone = maneuver_of(nodes, np.array([0.0]), tripod())
    for plot in (alone.plot_clearance, alone.plot_strokes, alone.plot_tip_error, alone.plot_step_time):
        assert isinstance(plot(), Figure)


@pytest.mark.smoke
def test_colours_go_from_blue_to_red_and_fixed_members_are_grey(maneuver: vq.Maneuver):
    short, long = stroke_colours(np.array([0.0, 1.0]))
    assert short[2] > 2 * short[0]
    assert long[0] > 2 * long[2]
    drawing = drawing_of_maneuver(maneuver)
    colours = drawing.colours(maneuver.member_lengths[0])
    fixed = ~maneuver.member_actuated
    assert np.ptp(colours[fixed], axis=1).max() < 0.05
    assert np.ptp(colours[~fixed], axis=1).min() > 0.1
    share = drawing.stroke_share(np.full(6, 1.25))
    assert np.allclose(share[[0, 5]], 0.5)
    assert np.isnan(share[1:5]).all()


@pytest.mark.smoke
def test_states_between_states_are_on_straight_lines(maneuver: vq.Maneuver):
    middle = resampled(maneuver.time, maneuver.nodes, np.array([0.25, 1.0]))
    assert np.allclose(middle[0], (maneuver.nodes[0] + maneuver.nodes[1]) / 2)
    assert np.array_equal(middle[1], maneuver.nodes[2])
    assert resampled(maneuver.time, maneuver.control_vertices, np.array([0.25])).shape == (1, 0, 3)


@pytest.mark.smoke
def test_the_camera_sees_the_whole_maneuver(maneuver: vq.Maneuver):
    camera = camera_for(drawing_of_maneuver(maneuver), maneuver.nodes, maneuver.tip_position)
    ahead = camera.target - camera.position
    distance = np.linalg.norm(ahead)
    ray = maneuver.nodes.reshape(-1, 3) - camera.position
    along = ray @ ahead / distance
    aside = np.linalg.norm(ray - along[:, None] * ahead / distance, axis=1)
    assert np.all(along > 0.0)
    assert np.all(np.arctan2(aside, along) < camera.field_of_view / 2)
