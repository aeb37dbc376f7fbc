"""``[curve]``: the reference curve that an arm tracks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, PrivateAttr, ValidationInfo, ValidatorFunctionWrapHandler, WrapValidator

from vgtm_qp.problem.fields import ByKey, Factor, NonNegative, Number, Vector, count, unexpected
from vgtm_qp.problem.own import own_answer, own_name
from vgtm_qp.problem.table import Place, Table, shown, unique


class VertexGoal(Table, called="a control vertex goal"):
    """A place that a control vertex is drawn to in the null space of the tip's motion."""

    index: Annotated[int, count(0, 999)] = Field(
        description="number of the control vertex, from 0 at the base"
    )
    position: Vector = Field(description="where it should go, m")


class _Curve(Table):
    control_vertices: Annotated[int, count(3, 1000)] = Field(
        default=6,
        description="number V of control vertices; at most the number of bays plus 2 for the curve methods",
    )
    torsion_vertices: Annotated[int, count(0, 1000)] = Field(
        default=0,
        description="number of torsion coordinates of the curve's frame; 0 is no torsion of its own",
    )
    nodes: Literal["parameter", "arc-length"] = Field(
        default="parameter",
        description="whether curve nodes keep their parameter or their share of the arc length",
    )
    control_vertex_goals: tuple[VertexGoal, ...] = Field(
        default=(), description="places that control vertices are drawn to"
    )

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        yield from unique("control_vertex_goals", "index", [goal.index for goal in self.control_vertex_goals])
        for i, goal in enumerate(self.control_vertex_goals):
            if goal.index >= self.control_vertices:
                last = self.control_vertices - 1
                yield ("control_vertex_goals", i, "index"), f"a control vertex, 0 to {last}"


class BezierCurve(_Curve, called="a Bezier curve"):
    """One Bezier curve of degree V - 1."""

    family: Literal["bezier"] = "bezier"
    control_vertices: Annotated[int, count(3, 60)] = Field(
        default=6, description="number V of control vertices"
    )


class BSplineCurve(_Curve, called="a B-spline curve"):
    """A clamped uniform B-spline."""

    family: Literal["b-spline"]
    degree: Annotated[int, count(1, 20)] = Field(
        default=3, description="degree, less than the number of vertices"
    )

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        yield from super()._contradictions()
        if self.degree >= self.control_vertices:
            yield ("degree",), f"a degree less than the number of control vertices, {self.control_vertices}"


class BetaSplineCurve(_Curve, called="a Beta-spline curve"):
    """A uniform cubic Beta-spline through its end vertices."""

    family: Literal["beta-spline"]
    bias: Factor = Field(
        default=1.0, description="ratio of the speeds after and before a joint; 1 is unbiased"
    )
    tension: NonNegative = Field(default=0.0, description="pull towards the control vertices; 0 is none")


class SegmentCurve(_Curve, called="a curve of Bezier segments"):
    """A chain of Bezier segments of one degree, given by their points; a family of the user's own becomes one."""

    _made_from: dict[str, Any] | None = PrivateAttr(None)

    family: Literal["segments"]
    breaks: tuple[NonNegative, ...] = Field(
        min_length=2, description="parameters at which the segments begin and end, from 0 to 1"
    )
    extraction: tuple[tuple[tuple[Number, ...], ...], ...] = Field(
        min_length=1,
        description="of each segment its Bezier points, each by the weights of the control vertices, whose sum is 1",
    )

    @property
    def made_from(self) -> dict[str, Any] | None:
        """The table of the user's own family that the segments were made from; None if they were written as such."""
        return self._made_from

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        yield from super()._contradictions()
        if len(self.extraction) != len(self.breaks) - 1:
            yield ("extraction",), f"{len(self.breaks) - 1} segments, one between two breaks"
        points = len(self.extraction[0])
        for k, segment in enumerate(self.extraction):
            if len(segment) != points or points < 2:
                yield ("extraction", k), f"{max(points, 2)} points, one more than the degree of all segments"
            for j, weights in enumerate(segment):
                if len(weights) != self.control_vertices:
                    yield ("extraction", k, j), f"{self.control_vertices} weights, one a control vertex"


def _from_own_family(
    value: Any, handler: ValidatorFunctionWrapHandler, info: ValidationInfo
) -> BezierCurve | BSplineCurve | BetaSplineCurve | SegmentCurve:
    """Return the table of a curve; that of a family of the user's own becomes one of Bezier segments."""
    name = own_name("curve", value, "family")
    if name is None:
        return handler(value)  # type: ignore[no-any-return]
    answer, given = own_answer("curve", name, value, "family", _Curve.model_fields, info)
    try:
        breaks, extraction = (np.array(part, dtype=float) for part in answer)
    except (TypeError, ValueError):
        breaks = extraction = np.zeros(0)
    if breaks.ndim != 1 or extraction.ndim != 3:
        raise unexpected(
            f'two arrays from the curve "{name}": breaks (S + 1,) and weights (S, degree + 1, control vertices) of '
            f"Bezier points; it returned {shown(answer)}"
        )
    size = {"control_vertices": extraction.shape[2]}
    segments = {"family": "segments", "breaks": breaks.tolist(), "extraction": extraction.tolist()}
    curve = handler({**given, **size, **segments})
    assert isinstance(curve, SegmentCurve)
    curve._made_from = dict(value)
    return curve


CurveTable = Annotated[
    BezierCurve | BSplineCurve | BetaSplineCurve | SegmentCurve,
    ByKey("family", kind="curve"),
    WrapValidator(_from_own_family),
]
