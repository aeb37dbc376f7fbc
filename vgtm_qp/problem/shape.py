"""``[curve]``: the reference curve that an arm tracks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field

from vgtm_qp.problem.fields import ByKey, Factor, NonNegative, Vector, count
from vgtm_qp.problem.table import Place, Table, unique


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


Curve = Annotated[BezierCurve | BSplineCurve | BetaSplineCurve, ByKey("family")]
