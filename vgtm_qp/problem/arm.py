"""``[arm]``: a serial arm in the place of a truss, from a list of joints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from vgtm_qp.problem.fields import (
    ORIGIN,
    Direction,
    Distance,
    Limit,
    Name,
    Number,
    Onset,
    Vector,
    count,
    exactly,
)
from vgtm_qp.problem.table import Place, Table, increasing, known_names, unique
from vgtm_qp.problem.truss import BasePose, LockTable


class Joint(Table, called="a joint"):
    """A joint of a serial arm, placed in the frame of the joint before it."""

    name: Name = Field(description="name of the joint")
    kind: Literal["revolute", "prismatic"] = Field(default="revolute", description="how it moves")
    axis: Direction = Field(description="axis in its own frame; need not be a unit vector")
    position: Vector = Field(default=ORIGIN, description="origin in the frame of the joint before, m")
    rotation_vector: Vector = Field(
        default=ORIGIN, description="attitude in that frame at joint value 0, rad"
    )
    limits: Annotated[tuple[Number, Number], exactly(2, "two numbers [least, greatest]")] | None = Field(
        default=None, description="least and greatest joint value, rad or m"
    )
    home: Number = Field(default=0.0, description="joint value of the home pose, rad or m")
    rate: Limit | None = Field(default=None, description="greatest speed, rad/s or m/s")
    acceleration: Limit | None = Field(default=None, description="greatest acceleration, rad/s^2 or m/s^2")

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        if self.limits is None:
            return
        if self.limits[0] >= self.limits[1]:
            yield ("limits",), "[least, greatest] with the least value first and below the greatest"
        elif not self.limits[0] <= self.home <= self.limits[1]:
            yield ("home",), f"a value within the limits, {self.limits[0]:g} to {self.limits[1]:g}"


class JointLock(LockTable, called="a locked joint"):
    """A joint that is stuck at its value, from the start or from a time on."""

    key = "joint"

    joint: Name = Field(description="name of the joint")
    time: Onset = Field(default=0.0, description="time at which it jams, s; 0 is from the start")

    @model_validator(mode="before")
    @classmethod
    def _from_member(cls, data: Any) -> Any:
        """Read `member`, the key of a truss, which files of serial arms had."""
        if not isinstance(data, Mapping) or "member" not in data or "joint" in data:
            return data
        return {"joint" if key == "member" else key: value for key, value in data.items()}


class ArmTable(Table, called="an arm"):
    """A serial arm."""

    later = dict.fromkeys(
        ("urdf", "package_path", "base_link", "tip_link", "home", "bodies"),
        "a list of joints [[arm.joint]]; URDF files are not read by this version",
    )

    joint: tuple[Joint, ...] = Field(default=(), description="the joints, base first")
    tip: Vector = Field(default=ORIGIN, description="position of the end effector in the last frame, m")
    link_radius: Distance = Field(
        default=0.03, description="radius of the capsules between successive joints, m"
    )
    every: Annotated[int, count(1, 1000)] | None = Field(
        default=None,
        description="which joints' frames track the curve: every so many; where absent, as few as keep to it exactly",
    )
    locked: tuple[JointLock, ...] = Field(
        default=(), description="joints that are stuck: names, or tables of joint and time"
    )
    base_motion: tuple[BasePose, ...] = Field(
        default=(), description="poses of a moving base, in the order of time"
    )

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        yield from increasing("base_motion", [pose.time for pose in self.base_motion])
        yield from unique("locked", "joint", [lock.joint for lock in self.locked])
        if not self.joint:
            yield ("joint",), "a list of joints [[arm.joint]]"
        yield from unique("joint", "name", [joint.name for joint in self.joint])
        names = {joint.name: joint for joint in self.joint}
        for i, lock in enumerate(self.locked):
            yield from known_names(("locked", i), (lock.joint,), names, key="joint")
