"""``[truss]``: a module stacked into bays, or any graph of nodes and members."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    Field,
    GetJsonSchemaHandler,
    PrivateAttr,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from vgtm_qp.problem.fields import (
    ORIGIN,
    ByKey,
    Distance,
    Flag,
    Length,
    Name,
    Onset,
    Seconds,
    Stroke,
    UpperLimit,
    Vector,
    count,
    exactly,
    unexpected,
)
from vgtm_qp.problem.own import own_answer, own_name
from vgtm_qp.problem.table import Place, Table, increasing, known_names, shown, unique

_SLACK = 1e-9

_NodePair = Annotated[tuple[Name, Name], exactly(2, "the names of two nodes")]
_Positions = Annotated[tuple[Vector, Vector], exactly(2, "two positions [[x, y, z], [x, y, z]]")]


class LockTable(Table):
    """An actuator that is stuck, from the start or from a time on: its name, or a table of name and time."""

    key: ClassVar[str]
    """Key of the name."""

    @property
    def actuator(self) -> str:
        """Name of the actuator."""
        return str(getattr(self, self.key))

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, data: Any) -> Any:
        if isinstance(data, str):
            return {cls.key: data}
        if isinstance(data, Mapping | LockTable):
            return data
        raise unexpected(f"the name of an actuated {cls.key}, or a table of {cls.key} and time")

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        table = handler.resolve_ref_schema(handler(schema))
        return {"anyOf": [{"type": "string", "minLength": 1}, dict(table)]}


class Lock(LockTable, called="a locked member"):
    """A member that is stuck at its length, from the start or from a time on."""

    key = "member"

    member: Name = Field(description="name of the actuated member")
    time: Onset = Field(default=0.0, description="time at which it jams, s; 0 is from the start")


class BasePose(Table, called="a base pose"):
    """A pose of the base that it reaches at a time, eqs. (7)-(8); its home pose at time 0 is the identity."""

    time: Seconds = Field(description="time at which the base is there, s")
    position: Vector = Field(default=ORIGIN, description="position of the base frame's origin, m")
    rotation_vector: Vector = Field(default=ORIGIN, description="rotation of the base frame, rad")


class _Truss(Table):
    thickness: ClassVar[Place] = ("truss", "member_radius")

    rate: UpperLimit | None = Field(
        default=None, description="greatest |d length / dt| of an actuated member, m/s"
    )
    acceleration: UpperLimit | None = Field(
        default=None, description="greatest |d2 length / dt2| of an actuated member, m/s^2"
    )
    member_radius: Distance = Field(default=0.03, description="radius of every member, a capsule, m")
    joint_offset: Distance = Field(
        default=0.0, description="distance from node to member end along the member, m"
    )
    locked: tuple[Lock, ...] = Field(
        default=(), description="actuated members that are stuck: names, or tables of member and time"
    )
    base_motion: tuple[BasePose, ...] = Field(
        default=(), description="poses of a moving base, in the order of time"
    )

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        yield from increasing("base_motion", [pose.time for pose in self.base_motion])
        yield from unique("locked", "member", [lock.member for lock in self.locked])

    def _misfits(
        self, stroke: Stroke | None, shortest: float, actuated: Mapping[str, float]
    ) -> Iterator[tuple[Place, str]]:
        """Yield a joint offset or a stroke that does not fit the home lengths between nodes.

        `shortest` is the least of all; `actuated` has those of actuated members by their key.
        """
        if 2 * self.joint_offset >= shortest:
            yield ("joint_offset",), f"less than half the shortest member, {shortest / 2:g} m"
        elif stroke:
            for key, length in actuated.items():
                yield from holds_home(("stroke",), stroke, length - 2 * self.joint_offset, key)


class _Stack(_Truss, called="a truss made of bays"):
    bays: Annotated[int, count(1, 10_000)] = Field(description="number of bays")
    longeron: Length = Field(
        default=1.0, description="home length of the members that join one face to the next, m"
    )
    batten: Length = Field(default=1.0, description="home length of the members of a face, m")
    stroke: Stroke | None = Field(
        default=None,
        description="least and greatest length of an actuated member, m; the module's own where absent",
    )

    def _actuated_lengths(self) -> Mapping[str, float]:
        """Home lengths between the nodes of the actuated members, m, by the key that gives them."""
        return {}

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        yield from super()._contradictions()
        yield from self._misfits(self.stroke, min(self.longeron, self.batten), self._actuated_lengths())


class ModuleTruss(_Stack, called="a truss of this module"):
    """Triangular faces stacked along +z: octahedral, double-octahedral, hexapod or longeron bays."""

    module: Literal["octahedral", "double-octahedral", "hexapod", "longeron"] = Field(
        description="octahedral: fixed longerons, actuated battens; double-octahedral: two such bays, every "
        "second face rigid; hexapod: rigid faces, six actuated legs; longeron: actuated longerons, fixed "
        "diagonals of alternating hand"
    )

    def _actuated_lengths(self) -> Mapping[str, float]:
        if self.module in ("octahedral", "double-octahedral"):
            return {"batten": self.batten}
        return {"longeron": self.longeron}

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        yield from super()._contradictions()
        flat = math.sqrt(3) * self.longeron
        if self.module != "longeron" and self.batten >= flat * (1 - _SLACK):
            yield ("batten",), f"less than sqrt(3) times the longeron, {flat:g} m, where a bay folds flat"


class TetrahedralTruss(_Stack, called="a tetrahedral truss"):
    """Tetrahedra face on face: each node hangs by three members on the three nodes before it."""

    module: Literal["tetrahedral"]
    longeron: Length = Field(default=1.0, description="home length of the member to the third node before, m")
    batten: Length = Field(
        default=1.0, description="home length of the members to the first and second node before, m"
    )
    actuated: tuple[Annotated[int, count(1, 3)], ...] = Field(
        default=(1, 2, 3),
        min_length=1,
        description="which k of a node's members, to the k-th node before, are actuated",
    )

    def _actuated_lengths(self) -> Mapping[str, float]:
        lengths = {"batten": self.batten} if {1, 2} & set(self.actuated) else {}
        return lengths | ({"longeron": self.longeron} if 3 in self.actuated else {})

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        yield from super()._contradictions()
        if len(set(self.actuated)) < len(self.actuated):
            yield ("actuated",), "one to three different numbers of 1, 2, 3"
        flat = math.sqrt(3) * self.batten
        if self.longeron >= flat * (1 - _SLACK):
            yield ("longeron",), f"less than sqrt(3) times the batten, {flat:g} m, where the helix folds flat"


class Node(Table, called="a node"):
    """A node of a graph."""

    name: Name = Field(description="name of the node")
    position: Vector = Field(description="home position, m")
    fixed: Flag = Field(default=False, description="whether it belongs to the base, eq. (7)")
    joint: _NodePair | None = Field(
        default=None,
        description="two other nodes that span its joint's frame with it, counter-clockwise about z",
    )


class Member(Table, called="a member"):
    """A member of a graph; its length is fixed where it is not actuated."""

    name: Name = Field(description="name of the member")
    nodes: _NodePair = Field(description="names of its two nodes")
    actuated: Flag = Field(default=False, description="whether it changes its length")
    length: Length | None = Field(
        default=None, description="home length, m; as the node positions give it where absent"
    )
    stroke: Stroke | None = Field(default=None, description="least and greatest length, m")
    rate: UpperLimit | None = Field(default=None, description="greatest |d length / dt|, m/s")
    acceleration: UpperLimit | None = Field(default=None, description="greatest |d2 length / dt2|, m/s^2")
    radius: Distance | None = Field(
        default=None, description="radius, m; the truss's member_radius where absent"
    )
    offsets: _Positions | None = Field(
        default=None, description="positions of its two ends in the frames of its nodes' joints, eq. (12), m"
    )

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        if self.nodes[0] == self.nodes[1]:
            yield ("nodes",), "the names of two different nodes"
        if not self.actuated:
            for key in ("stroke", "rate", "acceleration"):
                if getattr(self, key) is not None:
                    yield (key,), f"no {key}, since the member is not actuated"
        elif self.stroke and self.length is not None:
            yield from holds_home(("stroke",), self.stroke, self.length, "length")


class GraphTruss(_Truss, called="a truss given as a graph"):
    """Any truss, given by its nodes and members."""

    _made_from: dict[str, Any] | None = PrivateAttr(None)

    module: Literal["graph"]
    node: tuple[Node, ...] = Field(min_length=2, description="the nodes")
    member: tuple[Member, ...] = Field(min_length=1, description="the members")
    tip: tuple[Name, ...] = Field(
        min_length=1,
        description="nodes whose centroid, and best-fit frame if three or more, is the end effector",
    )
    faces: tuple[Annotated[tuple[Name, Name, Name], exactly(3, "the names of three nodes")], ...] = Field(
        default=(), description="triangles that the curve's nodes are tracked by, the base face first"
    )
    stroke: Stroke | None = Field(
        default=None,
        description="least and greatest length of an actuated member without a stroke of its own, m",
    )

    @property
    def made_from(self) -> dict[str, Any] | None:
        """The table of the user's own module that the graph was made from; None if it was written as a graph."""
        return self._made_from

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        yield from super()._contradictions()
        nodes = {node.name: node for node in self.node}
        members = {member.name: member for member in self.member}
        yield from unique("node", "name", [node.name for node in self.node])
        yield from unique("member", "name", [member.name for member in self.member])
        if all(node.fixed for node in self.node):
            yield ("node",), "at least one node that is not fixed"
        if not any(node.fixed for node in self.node):
            yield ("node",), "at least one node with fixed = true, the base"
        for i, node in enumerate(self.node):
            yield from known_names(("node", i, "joint"), node.joint or (), nodes)
            if node.joint and len({node.name, *node.joint}) < 3:
                yield ("node", i, "joint"), "two different nodes besides the node itself"
        for i, member in enumerate(self.member):
            yield from self._member_contradictions(i, member, nodes)
        yield from self._twins()
        yield from known_names(("tip",), self.tip, nodes)
        if len(set(self.tip)) < len(self.tip):
            yield ("tip",), "each node once"
        for i, face in enumerate(self.faces):
            yield from known_names(("faces", i), face, nodes)
            if len(set(face)) < 3:
                yield ("faces", i), "three different nodes"
        for i, lock in enumerate(self.locked):
            yield from known_names(("locked", i), (lock.member,), members, key="member")
            if lock.member in members and not members[lock.member].actuated:
                yield ("locked", i, "member"), "the name of an actuated member; this one has a fixed length"

    def _member_contradictions(
        self, index: int, member: Member, nodes: Mapping[str, Node]
    ) -> Iterator[tuple[Place, str]]:
        place = ("member", index)
        yield from known_names((*place, "nodes"), member.nodes, nodes)
        if not all(name in nodes for name in member.nodes):
            return
        if member.offsets:
            for name, end in zip(member.nodes, member.offsets, strict=True):
                if any(end) and not nodes[name].joint:
                    yield (*place, "offsets"), f'a joint at node "{name}": its two other nodes'
        distance = math.dist(*(nodes[name].position for name in member.nodes))
        offset = 2 * self.joint_offset if member.offsets is None else 0.0
        if distance <= offset + 1e-6:
            yield (
                (*place, "nodes"),
                f"two nodes further apart than {offset:g} m; these are {distance:g} m apart",
            )
        elif member.actuated and member.length is None and member.offsets is None:
            stroke = member.stroke or self.stroke
            at = (*place, "stroke") if member.stroke else ("stroke",)
            if stroke:
                yield from holds_home(
                    at, stroke, distance - offset, f'distance of the nodes of "{member.name}"'
                )

    def _twins(self) -> Iterator[tuple[Place, str]]:
        seen: dict[frozenset[str], str] = {}
        for i, member in enumerate(self.member):
            other = seen.setdefault(frozenset(member.nodes), member.name)
            if other != member.name:
                yield ("member", i, "nodes"), f'two nodes that no other member joins; "{other}" joins these'


def _from_own_module(
    value: Any, handler: ValidatorFunctionWrapHandler, info: ValidationInfo
) -> ModuleTruss | TetrahedralTruss | GraphTruss:
    """Return the table of a truss; that of a module of the user's own becomes a graph."""
    name = own_name("module", value, "module")
    if name is None:
        return handler(value)  # type: ignore[no-any-return]
    shared = (*_Truss.model_fields, "stroke")
    answer, given = own_answer("module", name, value, "module", shared, info)
    if not isinstance(answer, Mapping):
        raise unexpected(
            f'a mapping of node, member, tip and faces from the module "{name}"; it returned {shown(answer)}'
        )
    truss = handler({**given, **answer, "module": "graph"})
    assert isinstance(truss, GraphTruss)
    truss._made_from = dict(value)
    return truss


TrussTable = Annotated[
    ModuleTruss | TetrahedralTruss | GraphTruss,
    ByKey("module", later=("plate",), kind="module"),
    WrapValidator(_from_own_module),
]


def holds_home(
    place: Place, stroke: tuple[float, float], home: float, of: str
) -> Iterator[tuple[Place, str]]:
    """Yield the stroke if it excludes a home length."""
    if not stroke[0] - _SLACK <= home <= stroke[1] + _SLACK:
        yield place, f"a stroke that holds the home length, {home:g} m ({of})"
