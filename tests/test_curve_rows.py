"""The CasADi functions of a curve's nodes and rows against the curve itself, which gives them for any parameter."""

from __future__ import annotations

import numpy as np
import pytest
from arms import check_curve_rows

from vgtm_qp.builder import source_of
from vgtm_qp.compiled import compiler
from vgtm_qp.curve.curve import Curve
from vgtm_qp.curve.families import b_spline, beta_spline, bezier
from vgtm_qp.errors import CurveError
from vgtm_qp.qp.curve_rows import curve_function, point_function
from vgtm_qp.qp.shape import CurveRows, CurveShape
from vgtm_qp.rotation import rotation_from_vector

FAMILIES = [
    bezier(3),
    bezier(6),
    bezier(9),
    b_spline(7, 3),
    b_spline(8, 4, [0.2, 0.3, 0.7]),
    b_spline(6, 2),
    b_spline(4, 1),
    beta_spline(6),
    beta_spline(6, 1.4, 2.0),
]
OPTIONS = {
    "arc-length": {"by_arc_length": True},
    "torsion": {"torsion": 2, "tracks_roll": True},
    "roll": {"tracks_roll": True},
    "spacing": {"spacing": np.full(4, 0.7)},
    "arc-length and roll": {"by_arc_length": True, "tracks_roll": True},
    "everything": {"by_arc_length": True, "torsion": 1, "tracks_roll": True, "spacing": np.full(4, 0.7)},
}
NODES = np.array([0.21, 0.5, 0.83, 1.0])


@pytest.fixture(autouse=True)
def _without_a_compiler(monkeypatch):
    monkeypatch.setenv("VGTM_CC", "none")


def shapes():
    """Every family with every option that it can have."""
    found = []
    for number, family in enumerate(FAMILIES):
        for name, options in OPTIONS.items():
            if family.smooth or not options.get("tracks_roll"):
                shape = CurveShape(family, NODES, roll=np.array([0.1, -0.3, 2.0, 0.0]), **options)
                found.append(pytest.param(shape, id=f"{number}-{family.name}-{name}"))
    return found


def bent(shape, rng, bend):
    """Control vertices of a curve near a straight line, torsion, and the frame of its base."""
    vertices = 4.0 * shape.family.abscissae[:, None] * np.array([0.0, 0.0, 1.0])
    vertices = vertices + bend * rng.normal(size=vertices.shape)
    return vertices, rng.normal(size=shape.torsion), rotation_from_vector(0.4 * rng.normal(size=3))


def found(function, asked):
    """The results of a function, the last one apart: whether it says that they are right."""
    kernel = function.kernel(compiled=False)
    for argument, values in zip(kernel.inputs, (asked[0], asked[1], asked[2].T), strict=False):
        argument[:] = values.reshape(-1)
    kernel()
    return kernel.outputs[:-1], bool(kernel.outputs[-1][0])


@pytest.mark.parametrize("shape", shapes())
def test_they_give_what_the_curve_itself_gives(shape, rng):
    rows, points = curve_function(shape), point_function(shape)
    taken = 0
    for bend in [0.02] * 4 + [0.1] * 4 + [0.3] * 8:
        asked = bent(shape, rng, bend)
        wanted, (every, is_right) = shape.rows_of_any(*asked), found(rows, asked)
        taken += is_right
        if not is_right:
            continue
        for name, array, values in zip(CurveRows._fields, every, wanted, strict=True):
            scale = 1.0 + np.abs(values).max(initial=0.0)
            np.testing.assert_allclose(
                array.reshape(values.shape), values, rtol=0.0, atol=1e-10 * scale, err_msg=name
            )
        alone, is_right = found(points, asked)
        assert is_right
        for array, values in zip(alone, (wanted.position, wanted.frame), strict=True):
            np.testing.assert_allclose(array.reshape(values.shape), values, rtol=0.0, atol=1e-12)
    assert taken >= 4


def test_a_bend_that_is_too_sharp_for_the_cells_is_not_said_to_be_right():
    """Found by the test above: the speed is smooth in every cell, and the roll's rows were 3e-10 off."""
    shape = CurveShape(b_spline(7, 3), NODES, roll=np.array([0.1, -0.3, 2.0, 0.0]), tracks_roll=True)
    random = np.random.default_rng([1884783496, 4086071276])
    asked = [bent(shape, random, bend) for bend in [0.02] * 4 + [0.1] * 4 + [0.3] * 2]
    right = [found(curve_function(shape), one)[1] for one in asked]
    assert right == [True] * 8 + [False, True]


@pytest.mark.parametrize("shape", shapes())
def test_the_rows_are_the_derivatives_of_nodes_frames_and_spacings(shape, rng):
    check_curve_rows(shape, *bent(shape, rng, 0.03), atol=1e-6, turn_atol=1e-5)


@pytest.mark.parametrize("name", OPTIONS)
def test_nodes_alone_are_those_of_the_rows(name, rng):
    shape = CurveShape(bezier(6), NODES, **OPTIONS[name])
    asked = bent(shape, rng, 0.1)
    alone, rows = shape.at(*asked), shape.rows(*asked)
    np.testing.assert_allclose(alone.position, rows.position, atol=1e-14)
    np.testing.assert_allclose(alone.frame, rows.frame, atol=1e-14)
    for one, other in zip(alone, rows, strict=True):
        assert one.shape == other.shape
    # They do not share memory with the next ones.
    before = rows.position_rows.copy()
    shape.rows(*bent(shape, rng, 0.1))
    np.testing.assert_array_equal(rows.position_rows, before)


def nearly_a_cusp(sharpness):
    """A plane curve that slows down to `sharpness`, m, and turns round."""
    return np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 1.0], [sharpness, 0.0, 1.0], [1.0, 0.0, 0.0]])


@pytest.mark.parametrize("name", ["arc-length", "torsion", "everything"])
@pytest.mark.parametrize("sharpness", [1e-2, 1e-3, 1e-4, 1e-9])
def test_near_a_cusp_the_curve_itself_is_asked(name, sharpness):
    shape = CurveShape(bezier(4), NODES, **OPTIONS[name])
    base = rotation_from_vector([0.0, np.pi / 4, 0.0])
    asked = nearly_a_cusp(sharpness), np.zeros(shape.torsion), base
    assert not found(curve_function(shape), asked)[1]
    wanted, rows, alone = shape.rows_of_any(*asked), shape.rows(*asked), shape.at(*asked)
    for one, other in zip(rows, wanted, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(alone.position, wanted.position, atol=1e-12)
    np.testing.assert_allclose(alone.frame, wanted.frame, atol=1e-9)
    if shape.by_arc_length:
        curve = Curve(shape.family, *asked)
        s = curve.arc_parameter(NODES)
        np.testing.assert_allclose(rows.position, curve.position(s), atol=1e-12)


@pytest.mark.parametrize("way", ["rows", "at"])
@pytest.mark.parametrize(
    ("family", "vertices", "message"),
    [
        (bezier(4), np.zeros((4, 3)), "derivative vanishes|turns back"),
        (bezier(3), [[0, 0, 0], [0, 0, -1], [1, 0, -2]], "against the base normal"),
        (bezier(3), [[0, 0, 0], [0, 0, 1], [0, 0, np.nan]], "finite numbers"),
        (b_spline(4, 1), [[0, 0, 0], [0, 0, 1], [0, 1, 2], [0, 1, 3]], "kinks"),
    ],
)
def test_a_curve_without_a_frame_is_refused(family, vertices, message, way):
    shape = CurveShape(family, np.array([0.5, 1.0]), torsion=1, tracks_roll=True)
    with pytest.raises(CurveError, match=message):
        getattr(shape, way)(np.array(vertices, dtype=float), np.zeros(1), np.eye(3))


def test_its_code_is_short(monkeypatch):
    monkeypatch.delenv("VGTM_CC")
    if compiler() is None:
        pytest.skip("no C compiler")
    sizes = [
        len(source_of(curve_function(CurveShape(bezier(count), NODES, **OPTIONS["everything"])).function))
        for count in (6, 12)
    ]
    assert sizes[0] < 110_000
    assert sizes[1] < 1.3 * sizes[0]
