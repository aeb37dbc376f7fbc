"""``[arm]``: a serial arm instead of a truss, from a URDF file or from a list of joints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field, ValidationError, ValidationInfo, model_validator
from pydantic_core import InitErrorDetails

from vgtm_qp.errors import Mistake, ProblemError
from vgtm_qp.problem.enclosing import spans_volume
from vgtm_qp.problem.fields import (
    ORIGIN,
    Direction,
    Distance,
    File,
    Kilograms,
    Name,
    Number,
    Onset,
    UpperLimit,
    Vector,
    count,
    exactly,
    unexpected,
)
from vgtm_qp.problem.table import IN_FILE, Place, Table, increasing, known_names, unique
from vgtm_qp.problem.truss import BasePose, LockTable
from vgtm_qp.problem.urdf import UrdfJoint, read_urdf

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MOST_POINTS = 5000
"""Greatest number of points of a body."""

OF_URDF = ("urdf", "package_path", "base_link", "tip_link", "home", "bodies")
"""Keys that say which arm is read from a URDF file, and how it is read."""
FROM_URDF = ("joint", "tip", "tip_rotation_vector", "body")
"""Keys that are read from the URDF file."""


class Mimic(Table, called="what a joint follows"):
    """The joint that another one follows: the follower's value is a multiple of its value, plus an offset."""

    joint: Name = Field(description="name of the joint that is followed")
    multiplier: Number = Field(default=1.0, description="change of the value per change of that joint's")
    offset: Number = Field(default=0.0, description="value where that joint's is 0, rad or m")

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        if self.multiplier == 0.0:
            yield ("multiplier",), "a number other than 0"


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
    rate: UpperLimit | None = Field(default=None, description="greatest speed, rad/s or m/s")
    acceleration: UpperLimit | None = Field(
        default=None, description="greatest acceleration, rad/s^2 or m/s^2"
    )
    effort: UpperLimit | None = Field(
        default=None, description="greatest torque, N m, or force, N, of its drive"
    )
    mass: Kilograms = Field(default=0.0, description="of what it moves up to the next joint, kg")
    center_of_mass: Vector = Field(
        default=ORIGIN, description="where that has its centre, in its own frame, m"
    )
    mimic: Mimic | None = Field(
        default=None,
        description="the joint that it follows: {joint, multiplier, offset}; its home and its drive are that joint's",
    )

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        if self.limits is None:
            return
        if self.limits[0] >= self.limits[1]:
            yield ("limits",), "[least, greatest] with the least value first and below the greatest"
        elif self.mimic is None and not self.limits[0] <= self.home <= self.limits[1]:
            yield ("home",), f"a value within the limits, {self.limits[0]:g} to {self.limits[1]:g}"


class JointLock(LockTable, called="a locked joint"):
    """A joint that is stuck at its value, from the start or from a time on."""

    key = "joint"

    joint: Name = Field(description="name of the joint")
    time: Onset = Field(default=0.0, description="time at which it jams, s; 0 is from the start")

    @model_validator(mode="before")
    @classmethod
    def _from_member(cls, data: Any) -> Any:
        """Read `member`, the key of a truss, which older files of serial arms have."""
        if not isinstance(data, Mapping) or "member" not in data or "joint" in data:
            return data
        return {"joint" if key == "member" else key: value for key, value in data.items()}


class ArmBody(Table, called="a body"):
    """A ball, capsule or convex hull that moves with a joint and is kept clear of obstacles."""

    name: Name = Field(description="name of the body")
    joint: Name | None = Field(
        default=None, description="the joint that it moves with; where absent, it is fixed to the base"
    )
    points: Annotated[tuple[Vector, ...], Field(min_length=1, max_length=MOST_POINTS)] = Field(
        description="a ball's centre, both ends of a capsule's axis, or four points or more, whose hull the body is; "
        "in the frame of that joint, m"
    )
    radius: Distance = Field(default=0.0, description="of a ball or capsule, or thickness round a hull, m")

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        count = len(self.points)
        if count <= 2 and self.radius == 0.0:
            yield ("radius",), "a number above 0: the radius of a ball or capsule, m"
        if count == 3 or (count > 3 and not spans_volume(self.points)):
            yield ("points",), "one point, two, or four and more that are not in one plane"


class ArmTable(Table, called="an arm"):
    """A serial arm."""

    thickness: ClassVar[Place] = ("arm", "link_radius")

    urdf: File | None = Field(
        default=None, description="URDF file, relative to the problem file: gives joints, tip and bodies"
    )
    package_path: tuple[str, ...] = Field(
        default=(), description="folders in which package:// files of the URDF are looked up too"
    )
    base_link: Name | None = Field(default=None, description="link of the URDF that the arm starts from")
    tip_link: Name | None = Field(
        default=None, description="link of the URDF whose frame is the end effector"
    )
    home: tuple[Number, ...] | None = Field(
        default=None,
        description="joint values of the home pose of a URDF, rad or m; 0 within the limits where absent",
    )
    bodies: Literal["hull", "capsule", "primitives"] = Field(
        default="hull",
        description="what stands for the collision shapes of a URDF: their convex hulls, enclosing capsules, or the "
        "shapes themselves, which then may not be meshes",
    )
    joint: tuple[Joint, ...] = Field(default=(), description="the joints, base first")
    tip: Vector = Field(default=ORIGIN, description="position of the end effector in the last frame, m")
    tip_rotation_vector: Vector | None = Field(
        default=None,
        description="attitude of the end effector in the last frame, rad; along the arm at home where absent",
    )
    body: tuple[ArmBody, ...] | None = Field(
        default=None, description="what is kept clear; without any, capsules between successive joints"
    )
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

    @model_validator(mode="before")
    @classmethod
    def _from_urdf(cls, data: Any, info: ValidationInfo) -> Any:
        """Read joints, tip and bodies from the URDF file, unless they were read before."""
        context = info.context or {}
        # A file that a result names is not read: it may be any file.
        if not isinstance(data, Mapping) or data.get("urdf") is None or context.get("of_result"):
            return data
        if "joint" not in data:
            return {**data, **_urdf_keys(data, context)}
        if context.get("check_files"):
            twice = [key for key in FROM_URDF if key in data]
            raise _wrong([((key,), data[key], "no such key beside urdf, which gives it") for key in twice])
        return data

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        yield from increasing("base_motion", [pose.time for pose in self.base_motion])
        yield from unique("locked", "joint", [lock.joint for lock in self.locked])
        if not self.joint:
            yield ("joint",), "a list of joints [[arm.joint]], or a urdf in its place"
        yield from unique("joint", "name", [joint.name for joint in self.joint])
        names = {joint.name: joint for joint in self.joint}
        yield from self._followed(names)
        for i, body in enumerate(self.body or ()):
            if body.joint is not None:
                yield from known_names(("body", i), (body.joint,), names, key="joint")
        yield from unique("body", "name", [body.name for body in self.body or ()])
        if self.urdf is None:
            for key in OF_URDF[1:5]:
                if getattr(self, key):
                    yield (key,), "no such key without urdf; joints of a list have a home of their own"
        for i, lock in enumerate(self.locked):
            yield from known_names(("locked", i), (lock.joint,), names, key="joint")
            mimic = names[lock.joint].mimic if lock.joint in names else None
            if mimic is not None:
                yield (
                    ("locked", i, "joint"),
                    f'a joint that moves by itself, such as "{mimic.joint}", which it follows',
                )

    def _followed(self, names: Mapping[str, Joint]) -> Iterator[tuple[Place, str]]:
        """Yield what is wrong with joints that follow others."""
        for i, joint in enumerate(self.joint):
            if joint.mimic is None:
                continue
            followed = names.get(joint.mimic.joint)
            yield from known_names(("joint", i, "mimic"), (joint.mimic.joint,), names, key="joint")
            if followed is None:
                continue
            if followed.mimic is not None:
                yield ("joint", i, "mimic", "joint"), "a joint that moves by itself"
                continue
            value = joint.mimic.multiplier * followed.home + joint.mimic.offset
            if joint.limits is not None and not joint.limits[0] <= value <= joint.limits[1]:
                yield (
                    ("joint", i, "limits"),
                    f"limits that hold {value:g}, what it has at home by what it follows",
                )

    def home_values(self) -> list[float]:
        """Return the joints' values at home, rad or m."""
        home = {joint.name: joint.home for joint in self.joint}
        rules = [joint.mimic for joint in self.joint]
        return [
            own if rule is None else rule.multiplier * home[rule.joint] + rule.offset
            for own, rule in zip(home.values(), rules, strict=True)
        ]


def _urdf_keys(data: Mapping[str, Any], context: Mapping[str, Any]) -> dict[str, Any]:
    """Return joints, tip and bodies of the URDF file that an ``[arm]`` table names, as keys of such a table."""
    folder = Path(context.get("folder") or Path.cwd())
    file, places = data["urdf"], data.get("package_path") or ()
    links = {key: data.get(key) for key in ("base_link", "tip_link")}
    if not isinstance(file, str) or not all(isinstance(name, str | None) for name in links.values()):
        return {}
    try:
        if not (folder / Path(file).expanduser()).is_file():
            return {}
        found = [folder / Path(place).expanduser() for place in places]
        bodies = data.get("bodies", "hull")
        arm = read_urdf(folder / Path(file).expanduser(), **links, package_path=found, bodies=bodies)
    except ProblemError as error:
        raise _wrong([_of_file(file, mistake) for mistake in error.mistakes]) from None
    except (TypeError, ValueError, RuntimeError):
        # The types of the keys themselves report what is wrong with these.
        return {}
    home, own = data.get("home"), [joint for joint in arm.joints if joint.mimic is None]
    if home is None:
        home = [_least_bent(joint.limits) for joint in own]
    elif not isinstance(home, Sequence) or len(home) != len(own):
        names = ", ".join(joint.name for joint in own)
        raise _wrong([(("home",), home, f"{len(own)} joint values: {names}")])
    values = {joint.name: value for joint, value in zip(own, home, strict=True)}
    joints = [_joint_keys(joint, values.get(joint.name, 0.0)) for joint in arm.joints]
    bodies = [
        {"name": body.name, "points": body.points.tolist(), "radius": body.radius}
        | ({} if body.joint == 0 else {"joint": arm.joints[body.joint - 1].name})
        for body in arm.bodies
    ]
    tip = {"tip": arm.tip.tolist(), "tip_rotation_vector": _vector(arm.tip_rotation)}
    return {"joint": joints, **tip} | ({"body": bodies} if bodies else {})


def _of_file(file: str, mistake: Mistake) -> tuple[Place, str | None, str]:
    """Return place, value and expectation of a mistake in a URDF file, which the problem calls `file`."""
    value = None if mistake.value == "nothing" else mistake.value.strip('"')
    return (f"{IN_FILE}{file}, {mistake.key}",), value, mistake.expected


def _joint_keys(joint: UrdfJoint, home: Any) -> dict[str, Any]:
    """Return a joint of a URDF as the keys of one in a list of joints."""
    keys = {
        "name": joint.name,
        "kind": joint.kind,
        "axis": joint.axis.tolist(),
        "position": joint.position.tolist(),
        "rotation_vector": _vector(joint.rotation),
        "home": home,
    }
    mimic = None
    if joint.mimic is not None:
        mimic = dict(zip(("joint", "multiplier", "offset"), joint.mimic, strict=True))
    limits = {"limits": joint.limits, "rate": joint.rate, "effort": joint.effort, "mimic": mimic}
    if joint.mass:
        keys |= {"mass": joint.mass, "center_of_mass": joint.center_of_mass.tolist()}
    return keys | {key: value for key, value in limits.items() if value is not None}


def _vector(rotation: NDArray[np.float64]) -> list[float]:
    """Return the rotation vector, rad, of a (3, 3) rotation."""
    from scipy.spatial.transform import Rotation

    return [float(x) for x in Rotation.from_matrix(rotation).as_rotvec()]


def _least_bent(limits: tuple[float, float] | None) -> float:
    """Return 0 if the limits allow it, else their middle."""
    if limits is None or limits[0] <= 0.0 <= limits[1]:
        return 0.0
    return 0.5 * (limits[0] + limits[1])


def _wrong(found: Sequence[tuple[Place, Any, str]]) -> ValidationError:
    """Return the error of mistakes: place, value, and what was expected."""
    details = [
        InitErrorDetails(type=unexpected(expected), loc=place, input=value)
        for place, value, expected in found
    ]
    return ValidationError.from_exception_data("an arm", details)
