"""``[[obstacle]]`` and ``[clearance]``: what the arm keeps away from, and at what distance."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field

from vgtm_qp.problem.fields import (
    ORIGIN,
    Angle,
    ByKey,
    Distance,
    Edges,
    Factor,
    File,
    Flag,
    Length,
    Name,
    Vector,
)
from vgtm_qp.problem.table import Place, Table


def _names_shape(schema: dict[str, Any]) -> None:
    """Require the shape in a file; in Python the class says it."""
    schema["required"] = [*schema.get("required", ()), "shape"]


class _Obstacle(Table):
    model_config = ConfigDict(json_schema_extra=_names_shape)

    name: Name = Field(description="its name in messages and results")
    center: Vector = Field(description="position of its centre at time 0, m")
    rotation_vector: Vector = Field(default=ORIGIN, description="attitude, rad")
    velocity: Vector = Field(default=ORIGIN, description="constant velocity, m/s")


class Box(_Obstacle, called="a box"):
    """A box centred at `center`."""

    shape: Literal["box"] = "box"
    size: Edges = Field(description="edge length, or [sx, sy, sz], m")


class Sphere(_Obstacle, called="a sphere"):
    """A sphere."""

    shape: Literal["sphere"] = "sphere"
    radius: Length = Field(description="radius, m")


class Cylinder(_Obstacle, called="a cylinder"):
    """A cylinder centred at `center`, its axis along its own z."""

    shape: Literal["cylinder"] = "cylinder"
    radius: Length = Field(description="radius, m")
    height: Length = Field(description="height along its axis, m")


class Mesh(_Obstacle, called="a mesh"):
    """A triangle mesh from a file."""

    shape: Literal["mesh"] = "mesh"
    file: File = Field(description="STL or OBJ file, relative to the problem file")
    center: Vector = Field(default=ORIGIN, description="position of the mesh's own origin at time 0, m")
    scale: Factor = Field(default=1.0, description="factor that brings the file's unit to metres")


Obstacle = Annotated[Box | Sphere | Cylinder | Mesh, ByKey("shape", in_file=True)]


class ClearanceTable(Table, called="[clearance]"):
    """Distances, from surface to surface, that are kept at states and between them."""

    safe: Distance = Field(default=0.05, description="least distance from an obstacle, m")
    influence: Length = Field(default=0.5, description="distance below which a pair is in the QP, m")
    margin: Distance = Field(
        default=0.0002,
        description="distance that the QP keeps over the least one, so that the exact checks pass at once, m",
    )
    distance: Literal["fcl", "exact"] = Field(
        default="fcl",
        description="what gives the rows of pairs that can become active: FCL, each answer proven, or closed forms",
    )
    self_collision: Flag = Field(
        default=True, description="whether members that share no node keep apart too"
    )
    self_safe: Distance | None = Field(
        default=None, description="least distance between members, m; a quarter of safe where absent"
    )
    minimum_angle: Angle = Field(
        default=0.0, description="least angle between members that share a node, rad"
    )

    @property
    def between_members(self) -> float:
        """Least distance from surface to surface of members that share no node, m.

        A quarter of `safe` by default: the arm's own shape is known far better than the places of obstacles,
        and battens and longerons of a bent bay inevitably come near one another.
        """
        return 0.25 * self.safe if self.self_safe is None else self.self_safe

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        if self.influence <= self.safe:
            yield ("influence",), f"a distance greater than safe, {self.safe:g} m"
        if self.self_safe is not None and self.influence <= self.self_safe:
            yield ("self_safe",), f"a distance less than influence, {self.influence:g} m"
