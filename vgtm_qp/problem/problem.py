"""A whole problem: the arm, the shape it follows, the maneuver, the obstacles and the method."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from pydantic import Field, PrivateAttr, WithJsonSchema

from vgtm_qp.errors import Mistake, PartError, ProblemError, VgtmError
from vgtm_qp.notebook import html_table
from vgtm_qp.parts import Kind, find_part
from vgtm_qp.problem.arm import FROM_URDF, OF_URDF, ArmTable
from vgtm_qp.problem.fields import Name, expect, quoted
from vgtm_qp.problem.goal import EndEffector, ManeuverTable, Waypoint, WaypointManeuver
from vgtm_qp.problem.method import Method
from vgtm_qp.problem.obstacle import ClearanceTable, Obstacles
from vgtm_qp.problem.shape import BezierCurve, CurveTable, SegmentCurve
from vgtm_qp.problem.table import Place, Table, key_path, shown, unique, value_at
from vgtm_qp.problem.truss import GraphTruss, TrussTable

SCHEMA_VERSION = 1


class Problem(Table, called="a problem"):
    """A problem as its file gives it, or as keywords and dictionaries of the same names give it in Python.

    Paths of files are kept absolute; relative ones start at the problem file's folder, or at the working directory
    without a problem file.

    Raises
    ------
    ProblemError
        With one :class:`~vgtm_qp.errors.Mistake` per mistake.
    """

    later: ClassVar = {
        "surface": "a reference [curve]; surfaces belong to plates, which this version does not have",
        "loads": "no loads; this version knows no forces",
    }

    schema_version: Annotated[
        int,
        Field(strict=True, ge=SCHEMA_VERSION, le=SCHEMA_VERSION),
        WithJsonSchema({"const": SCHEMA_VERSION}),
        expect(f"{SCHEMA_VERSION}, the version of the problem file that this release reads"),
    ] = Field(default=SCHEMA_VERSION, description="version of the form of this file")
    name: Name = Field(default="unnamed", description="title in tables and figures")
    truss: TrussTable | None = Field(default=None, description="the arm: a truss")
    arm: ArmTable | None = Field(default=None, description="a serial arm, in the place of a truss")
    curve: CurveTable = Field(
        default_factory=BezierCurve, description="the reference curve; a Bezier of 6 vertices where absent"
    )
    end_effector: EndEffector = Field(
        default_factory=EndEffector, description="which coordinates are steered"
    )
    maneuver: ManeuverTable = Field(description="where the end effector goes")
    obstacle: Obstacles = Field(default=(), description="what the arm keeps away from")
    clearance: ClearanceTable = Field(default_factory=ClearanceTable, description="how far it keeps away")
    method: Method = Field(default_factory=Method, description="how each step is solved")

    _source: Path | None = PrivateAttr(None)

    @property
    def source(self) -> Path | None:
        """The file that the problem was read from, if any."""
        return self._source

    @property
    def arm_table(self) -> TrussTable | ArmTable:
        """The table that describes the arm; `thickness` is the place of what makes its bodies thick."""
        table = self.truss or self.arm
        assert table is not None
        return table

    def _repr_html_(self) -> str:
        method, ways = self.method, self.maneuver
        arm = f"serial, {len(self.arm.joint)} joints" if self.arm is not None else "none"
        if self.truss is not None:
            arm = f"truss, {self.truss.module}"
        way = (
            f"waypoints: {len(ways.waypoint)}, steps: {ways.steps}"
            if isinstance(ways, WaypointManeuver)
            else str(ways.path)
        )
        rows = [
            ("arm", arm),
            ("curve", f"{self.curve.family}, {self.curve.control_vertices} control vertices"),
            ("end effector", f"{', '.join(self.end_effector.track)}; {self.end_effector.mode}"),
            ("maneuver", way),
            ("obstacles", ", ".join(f"{one.name} ({one.shape})" for one in self.obstacle) or "none"),
            ("clearance", f"{self.clearance.safe:g} m"),
            ("method", f"{method.name}, {method.tracking}, {method.solver}"),
        ]
        return html_table(self.name, rows)

    def to_dict(self) -> dict[str, Any]:
        """Return the whole problem, defaults included, as JSON data of the form of the problem file."""
        return self.model_dump(mode="json", exclude_none=True)

    @classmethod
    def from_dict(
        cls,
        data: Mapping[str, Any],
        *,
        source: str | Path | None = None,
        check_files: bool = False,
        of_result: bool = False,
    ) -> Self:
        """Make a problem from what :meth:`to_dict` returned; ProblemError with one mistake per mistake.

        Mistakes name `source`, the file of the data, and relative paths start at its folder. With
        `check_files` the files that the problem names must exist; a result is read without, since it may have
        been moved elsewhere. With `of_result` values that the method does not use are allowed, since earlier
        versions solved such problems.
        """
        context = {"source": source, "check_files": check_files, "of_result": of_result}
        if source is not None:
            context["folder"] = Path(source).absolute().parent
        problem = cls.model_validate(data, context=context)
        problem._source = None if source is None else Path(source).absolute()
        return problem

    def replace(self, changes: Mapping[str, Any]) -> Self:
        """Return a problem with some values changed, by key path, and everything checked again.

        The changes are as in ``{"method.solver": "osqp", "maneuver.steps": 20}``. ProblemError where a key does not
        exist or a value is wrong.
        """
        data = self.to_dict()
        if any(f"arm.{key}" in changes for key in OF_URDF):
            data["arm"] = {key: value for key, value in data["arm"].items() if key not in FROM_URDF}
        # The keys are those of the user's own parts, which make the tables again.
        for kind, name, place, made_from in self._made_by_parts():
            if find_part(kind, made_from[name]) is not None:
                data[place] = dict(made_from)
        for key, value in changes.items():
            table = data
            *outer, last = key.split(".")
            for part in outer:
                inner = table.get(part)
                table[part] = table = dict(inner) if isinstance(inner, Mapping) else {}
            table[last] = value
        return self.from_dict(data, source=self._source)

    def _made_by_parts(self) -> Iterator[tuple[Kind, str, str, dict[str, Any]]]:
        """Yield the tables that parts of the user's own have made: kind, key of the part, table, and as written."""
        if isinstance(self.truss, GraphTruss) and self.truss.made_from is not None:
            yield "module", "module", "truss", self.truss.made_from
        if isinstance(self.curve, SegmentCurve) and self.curve.made_from is not None:
            yield "curve", "family", "curve", self.curve.made_from

    def mistake(self, place: Place, expected: str) -> Mistake:
        """Return a mistake that a later check found at a place such as ``("obstacle", 1, "center")``."""
        return Mistake(key_path(self, place), shown(value_at(self, place)), expected)

    def error(self, mistakes: Sequence[Mistake]) -> ProblemError:
        """Return the error of mistakes that a later check found."""
        return ProblemError(str(self.source or self.name), mistakes)

    @contextmanager
    def blaming(self, place: Place, expected: str) -> Iterator[None]:
        """Raise any other error of this package as a mistake at a place, with what is `expected` there.

        An error that ends in "; expected ..." has its own expectation. That of a part of the user's own stays one.
        """
        try:
            yield
        except (ProblemError, PartError):
            raise
        except VgtmError as error:
            found, _, other = str(error).partition("; expected ")
            raise self.error([Mistake(key_path(self, place), found, other or expected)]) from error

    def _unused(self) -> Iterator[tuple[Place, str]]:
        if self.curve.control_vertex_goals and not self.method.draws_vertices:
            yield (
                ("curve", "control_vertex_goals"),
                'none, since only "qp" with a curve draws control vertices',
            )
        if self.curve.nodes == "arc-length" and self.method.moves_curve_first:
            yield (
                ("curve", "nodes"),
                '"parameter", since a curve that moves first keeps the parameters of its nodes',
            )
        if self.end_effector.mode not in self.method.modes:
            yield ("end_effector", "mode"), f"{quoted(self.method.modes)}: the method has no other mode"

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        if self.truss is None and self.arm is None:
            yield ("truss",), "a table [truss], or a table [arm] in its place"
        if self.truss is not None and self.arm is not None:
            yield ("arm",), "a truss or an arm, not both"
        if self.arm is not None and self.method.goes_by_bays:
            yield ("method", "tracking"), '"coupled" or "none": the others go along the bays of a truss'
        if self.arm is not None and self.arm.body is not None and self.clearance.minimum_angle:
            yield ("clearance", "minimum_angle"), "0: bodies of their own do not meet in points"
        yield from unique("obstacle", "name", [obstacle.name for obstacle in self.obstacle])
        if isinstance(self.maneuver, WaypointManeuver):
            for i, waypoint in enumerate(self.maneuver.waypoint):
                for key, expected in _unmet(self.end_effector, waypoint):
                    yield ("maneuver", "waypoint", i, key), expected


def check_is_problem(value: object) -> None:
    """Raise ProblemError if a function is given something else than a problem, such as its name."""
    if isinstance(value, Problem):
        return
    if isinstance(value, str | Path):
        expected = f'a problem: vgtm_qp.load_problem("{value}") reads it'
    else:
        expected = "a problem, from vgtm_qp.load_problem(path) or vgtm_qp.Problem(...)"
    found = shown(str(value) if isinstance(value, Path) else value)
    raise ProblemError.at("argument", "problem", found, expected)


def _unmet(end_effector: EndEffector, waypoint: Waypoint) -> Iterator[tuple[str, str]]:
    """Yield key and expectation of each coordinate that a waypoint lacks, or has without use."""
    tracked = set(end_effector.track)
    turned = tracked & {"pointing", "orientation"}
    if tracked & {"position", "x", "y", "z"}:
        if waypoint.position is None:
            yield "position", "three numbers [x, y, z], since end_effector.track has it"
    elif waypoint.position is not None:
        yield "position", 'no position, since end_effector.track lacks "position"'
    if "orientation" in turned and waypoint.rotation_vector is None:
        yield "rotation_vector", 'three numbers [rx, ry, rz], since end_effector.track has "orientation"'
    if turned == {"pointing"} and waypoint.pointing is None and waypoint.rotation_vector is None:
        yield "pointing", 'a direction [x, y, z], since end_effector.track has "pointing"'
    if "pointing" not in turned and waypoint.pointing is not None:
        yield "pointing", 'no pointing, since end_effector.track lacks "pointing"'
    if not turned and waypoint.rotation_vector is not None:
        yield (
            "rotation_vector",
            'no rotation_vector, since end_effector.track lacks "orientation" and "pointing"',
        )
