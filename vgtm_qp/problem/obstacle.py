"""``[[obstacle]]`` and ``[clearance]``: what the arm keeps away from, and at what distance."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

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
    unexpected,
)
from vgtm_qp.problem.own import own_answer, own_name
from vgtm_qp.problem.table import Place, Table, shown


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


ObstacleTable = Annotated[Box | Sphere | Cylinder | Mesh, ByKey("shape", in_file=True, kind="obstacle")]


def _with_own_shapes(
    value: Any, handler: ValidatorFunctionWrapHandler, info: ValidationInfo
) -> tuple[Box | Sphere | Cylinder | Mesh, ...]:
    """Return the obstacles of a problem; one of a shape of the user's own becomes the obstacles it consists of.

    A mistake in one of these is one of the table that it was made from.
    """
    if not isinstance(value, list | tuple):
        return handler(value)  # type: ignore[no-any-return]
    tables: list[Any] = []
    origin: list[int] = []
    wrong: list[InitErrorDetails] = []
    for k, table in enumerate(value):
        try:
            made = _pieces(table, info)
        except ValidationError as error:
            wrong += [_moved(found, (k, *found["loc"])) for found in error.errors(include_url=False)]
        except PydanticCustomError as error:
            wrong.append(InitErrorDetails(type=error, loc=(k,), input=table))
        else:
            tables += made
            origin += [k] * len(made)
    if not wrong and len(tables) == len(value) and all(map(operator.is_, tables, value)):
        return handler(value)  # type: ignore[no-any-return]
    try:
        obstacles = handler(tables)
    except ValidationError as error:
        for found in error.errors(include_url=False):
            index, *inner = found["loc"]
            wrong.append(_moved(found, (origin[int(index)], *inner)))
    if wrong:
        raise ValidationError.from_exception_data("obstacle", wrong)
    return obstacles  # type: ignore[no-any-return]


Obstacles = Annotated[tuple[ObstacleTable, ...], WrapValidator(_with_own_shapes)]


class _Around(Table, called="a scene"):
    obstacle: Obstacles


def obstacles(*tables: Mapping[str, Any]) -> tuple[Box | Sphere | Cylinder | Mesh, ...]:
    """Return the obstacles of ``[[obstacle]]`` tables; one of a shape of the user's own as the pieces it consists of.

    ProblemError with one :class:`~vgtm_qp.errors.Mistake` per mistake.
    """
    return _Around.model_validate({"obstacle": list(tables)}).obstacle


def _moved(found: ErrorDetails, place: tuple[int | str, ...]) -> InitErrorDetails:
    """Return the error of a table at another place."""
    kind = PydanticCustomError(found["type"], found["msg"], found.get("ctx"))
    return InitErrorDetails(type=kind, loc=place, input=found["input"])


def _pieces(table: Any, info: ValidationInfo) -> list[Any]:
    """Return the tables that an obstacle of a user's own shape consists of; a table of the package's shapes alone."""
    name = own_name("obstacle", table, "shape")
    if name is None:
        return [table]
    answer, given = own_answer("obstacle", name, table, "shape", _Obstacle.model_fields, info)
    place = _Obstacle.model_validate(given, context=info.context)
    if (
        not isinstance(answer, list | tuple)
        or not answer
        or not all(isinstance(one, Mapping) for one in answer)
    ):
        raise unexpected(f'tables of obstacles from the shape "{name}"; it returned {shown(answer)}')
    made = []
    for number, piece in enumerate(answer, start=1):
        of = str(piece.get("name", number))
        called = place.name if len(answer) == 1 else f"{place.name}: {of}"
        made.append({**piece, "name": called, "velocity": place.velocity, **_placed(place, piece, name)})
    return made


def _placed(place: _Obstacle, piece: Mapping[str, Any], shape: str) -> dict[str, Any]:
    """Return center and rotation vector of a piece that stands in the frame of an obstacle."""
    # Imported only if there is a shape of one's own: the import takes a tenth of a second.
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(place.rotation_vector)
    try:
        own, center = (
            np.array(piece.get(key, ORIGIN), dtype=float).reshape(3) for key in ("rotation_vector", "center")
        )
    except (TypeError, ValueError):
        raise unexpected(
            f'three numbers for each center and rotation_vector from the shape "{shape}"'
        ) from None
    return {
        "center": (np.array(place.center) + turn.apply(center)).tolist(),
        "rotation_vector": (turn * Rotation.from_rotvec(own)).as_rotvec().tolist(),
    }


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
        description="what gives the rows of pairs that can become active: FCL, each answer proven, or closed forms; "
        "those of hulls are searched, by our own C in both, by FCL without a compiler",
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
