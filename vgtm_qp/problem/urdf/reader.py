"""From a URDF file to the chain of joints between two of its links."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import nearest
from vgtm_qp.problem.fields import quoted
from vgtm_qp.problem.urdf.frames import AT_REST, Frame, Origins, after, inverse
from vgtm_qp.problem.urdf.inertials import WEIGHTLESS, Mass, mass_of
from vgtm_qp.problem.urdf.shapes import Shapes
from vgtm_qp.problem.urdf.text import Element, Mistakes, read_xml
from vgtm_qp.problem.urdf.visuals import UrdfVisual, surfaces_of

LinkPlace = tuple[int, Frame]
"""Number of moving joints before a link, and its frame in that of the last of these."""

_MOVING = ("revolute", "continuous", "prismatic")
_OTHER = ("fixed", "floating", "planar")


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """A moving joint.

    Attributes
    ----------
    name : str
    kind : str
        ``"revolute"`` or ``"prismatic"``.
    axis : (3,)
        Unit vector in its own frame.
    position, rotation : (3,), (3, 3)
        Its origin, m, and attitude at joint value 0, in the frame of the moving joint before it; of the base for the
        first.
    limits : (float, float) or None
        rad or m; None for a continuous joint.
    rate, effort : float or None
    mass : float
        Of the links that it moves and the joint beyond it does not, kg.
    center_of_mass : (3,)
        Their centre in its frame, m.
    mimic : (str, float, float) or None
        Name of the joint that it follows, multiplier and offset. That joint is one of the arm, and follows
        none.
    """

    name: str
    kind: str
    axis: Array
    position: Array
    rotation: Array
    limits: tuple[float, float] | None
    rate: float | None
    effort: float | None
    mass: float
    center_of_mass: Array
    mimic: tuple[str, float, float] | None


@dataclass(frozen=True, eq=False)
class UrdfBody:
    """What stands for one collision shape: a ball, a capsule or a convex hull.

    Attributes
    ----------
    name : str
        That of its link; ``"link[2]"`` for the second shape of a link.
    joint : int
        Number of moving joints before it; 0 is fixed to the base.
    points : (K, 3)
        Centre, both ends of its axis, or four points or more of the hull, m, in the frame of the last of these joints.
    radius : float
        m.
    """

    name: str
    joint: int
    points: Array
    radius: float


@dataclass(frozen=True, eq=False)
class UrdfArm:
    """A chain of joints, base first.

    Attributes
    ----------
    joints : tuple of UrdfJoint
    tip, tip_rotation : (3,), (3, 3)
        Frame of the tip's link in that of the last joint, m.
    bodies : tuple of UrdfBody
    base_link, tip_link : str
    notes : tuple of str
        What was left out.
    files : tuple of Path
        What was read: the URDF file, then meshes.
    """

    joints: tuple[UrdfJoint, ...]
    tip: Array
    tip_rotation: Array
    bodies: tuple[UrdfBody, ...]
    base_link: str
    tip_link: str
    notes: tuple[str, ...]
    files: tuple[Path, ...]


def read_urdf(
    file: str | Path,
    *,
    base_link: str | None = None,
    tip_link: str | None = None,
    package_path: Sequence[str | Path] = (),
    bodies: str = "hull",
) -> UrdfArm:
    """Read the arm between two links of a URDF file.

    Parameters
    ----------
    file
        Links fixed to those of the arm belong to it; links that move beside it, or carry it, are left out.
    base_link, tip_link
        By default the root, and the end with the most moving joints.
    package_path
        Folders in which ``package://`` files are looked up, before those beside the file and above it.
    bodies
        What stands for collision shapes: ``"hull"``, ``"capsule"`` or ``"primitives"``, as in ``[arm]``.

    Raises
    ------
    ProblemError
        With one :class:`~vgtm_qp.errors.Mistake` for each fault, with its line.
    """
    path, mistakes = Path(file), Mistakes(Path(file))
    tree = _Tree(read_xml(path), mistakes)
    base, tip = tree.ends(base_link, tip_link)
    chain = tree.chain(base, tip)
    places, notes = tree.places(chain, base)
    joints, tip_frame = tree.moving(chain, places)
    shapes = Shapes(path, package_path, mistakes, bodies)
    found, bare = tree.bodies(places, shapes)
    mistakes.stop()
    return UrdfArm(joints, *tip_frame, found, base, tip, (*notes, *bare), (path, *shapes.files))


def read_visuals(
    file: str | Path,
    *,
    base_link: str | None = None,
    tip_link: str | None = None,
    package_path: Sequence[str | Path] = (),
) -> tuple[tuple[UrdfJoint, ...], tuple[UrdfVisual, ...]]:
    """Return the joints of the arm of :func:`read_urdf`, and what is drawn of its links.

    Shapes whose files are missing or damaged are left out. ProblemError where joints cannot be read.
    """
    path, mistakes = Path(file), Mistakes(Path(file))
    tree = _Tree(read_xml(path), mistakes)
    base, tip = tree.ends(base_link, tip_link)
    chain = tree.chain(base, tip)
    places, _ = tree.places(chain, base)
    joints, _ = tree.moving(chain, places)
    mistakes.stop()
    return joints, tuple(tree.visuals(places, Shapes(path, package_path, mistakes, "primitives")))


@dataclass(frozen=True, eq=False)
class _Joint:
    name: str
    kind: str
    parent: str
    child: str
    element: Element

    @property
    def moves(self) -> bool:
        return self.kind != "fixed"


class _Tree:
    """Links and joints of a file; ProblemError if they do not form a tree."""

    def __init__(self, root: Element, mistakes: Mistakes) -> None:
        self._root, self._mistakes = root, mistakes
        if root.tag != "robot":
            mistakes.add(root, "", f"<{root.tag}>", "<robot>, the root of a URDF file")
            mistakes.stop()
        self._refuse_xacro()
        for element in root.children:
            if element.tag in ("link", "joint"):
                mistakes.spelling(element, f'{element.tag} "{element.attributes.get("name", "")}"')
        mistakes.spelling(
            replace(root, children=[replace(child, children=[]) for child in root.children]), "<robot>"
        )
        mistakes.stop()
        self._links = self._named("link")
        mistakes.stop()
        self._origins = Origins(mistakes)
        self._joints = [self._joint(name, element) for name, element in self._named("joint").items()]
        if not self._links:
            mistakes.add(root, "<robot>", None, "links")
        mistakes.stop()
        self._above: dict[str, _Joint] = {}
        for joint in self._joints:
            if joint.child in self._above:
                other = self._above[joint.child].name
                expected = (
                    f'a link that no other joint moves: "{other}" has it too, and closed loops are not served'
                )
                mistakes.add(joint.element, f'joint "{joint.name}", <child>', joint.child, expected)
            self._above[joint.child] = joint
        mistakes.stop()
        self._below: dict[str, list[_Joint]] = {name: [] for name in self._links}
        for joint in self._joints:
            self._below[joint.parent].append(joint)
        self._refuse_loops()
        mistakes.stop()

    def ends(self, base: str | None, tip: str | None) -> tuple[str, str]:
        """Return the first and the last link of the arm: as given, or else the default ones."""
        roots = [name for name in self._links if name not in self._above]
        for key, name in (("base_link", base), ("tip_link", tip)):
            if name is not None and name not in self._links:
                names = quoted(list(self._links)[:12])
                self._wrong(f"{key} of the problem", name, f"one of {names}{nearest(name, self._links)}")
        if base is None and len(roots) != 1:
            said = (
                f"base_link in the problem: one of {quoted(roots[:12])}, since several links have no parent"
            )
            self._wrong("<robot>", None, said)
        self._mistakes.stop()
        base = base or roots[0]
        if tip is None:
            tip = self._longest(base)
        return base, tip

    def _longest(self, base: str) -> str:
        """Return the link without children that has the most moving joints before it."""
        parents = {joint.parent for joint in self._joints}
        found: dict[str, int] = {}
        for name in self._links:
            if name in parents or name == base:
                continue
            joints = self._upwards(name, base)
            if joints is not None:
                found[name] = sum(joint.moves for joint in joints)
        most = max(found.values(), default=0)
        ends = [name for name, count in found.items() if count == most]
        if len(ends) != 1:
            said = f"tip_link in the problem: one of {quoted(ends)}" if ends else "a link behind a joint"
            self._wrong("<robot>", None, said)
            self._mistakes.stop()
        return ends[0]

    def _upwards(self, tip: str, base: str) -> list[_Joint] | None:
        """Return the joints from the tip down to the base; None if they do not lead there."""
        joints, link, seen = [], tip, {tip}
        while link != base:
            joint = self._above.get(link)
            if joint is None or joint.parent in seen:
                return None
            joints.append(joint)
            link = joint.parent
            seen.add(link)
        return joints

    def chain(self, base: str, tip: str) -> list[_Joint]:
        """Return the joints from the base to the tip; ProblemError without any, or for a kind not served."""
        joints = self._upwards(tip, base)
        if joints is None:
            self._wrong("tip_link", tip, f'a link that joints connect with the base, "{base}"')
        self._mistakes.stop()
        assert joints is not None
        for joint in joints:
            if joint.kind not in (*_MOVING, "fixed"):
                expected = (
                    "a joint of the arm that turns or slides about one axis, or none; "
                    f'base_link = "{joint.child}" begins behind it'
                )
                self._mistakes.add(joint.element, f'joint "{joint.name}", type', joint.kind, expected)
        if not any(joint.moves for joint in joints):
            self._wrong("<robot>", None, f'joints that move between "{base}" and "{tip}"')
        self._mistakes.stop()
        moving = {joint.name for joint in joints if joint.moves}
        for joint in joints:
            rule = self._mimic(joint) if joint.moves else None
            if rule is not None and rule[0] not in moving:
                expected = f'a joint that moves between "{base}" and "{tip}", which this arm can drive'
                self._mistakes.add(joint.element, f'joint "{joint.name}", <mimic> joint', rule[0], expected)
        self._mistakes.stop()
        return joints[::-1]

    def _mimic(self, joint: _Joint) -> tuple[str, float, float] | None:
        """Return the joint that a joint follows in the end, with multiplier and offset; None without one.

        A joint may follow one that follows another.
        """
        multiplier, offset, seen, joints = 1.0, 0.0, [joint.name], {one.name: one for one in self._joints}
        while True:
            mimic = joint.element.first("mimic")
            if mimic is None:
                return (joint.name, multiplier, offset) if len(seen) > 1 else None
            what = f'joint "{joint.name}"'
            factor = (self._mistakes.numbers(mimic, what, "multiplier", 1, (1.0,)) or (1.0,))[0]
            more = (self._mistakes.numbers(mimic, what, "offset", 1, (0.0,)) or (0.0,))[0]
            other = mimic.attributes.get("joint")
            if factor == 0.0:
                self._mistakes.add(mimic, f"{what}, <mimic> multiplier", "0", "a number other than 0")
            if other not in joints or other in seen:
                expected = (
                    "a joint that it follows" if other in seen else f"a joint{nearest(str(other), joints)}"
                )
                self._mistakes.add(mimic, f"{what}, <mimic> joint", other, expected)
                self._mistakes.stop()
            assert other is not None
            # The value is multiplier * (factor * that of the other + more) + offset.
            multiplier, offset = multiplier * factor, offset + multiplier * more
            seen.append(other)
            joint = joints[other]

    def moving(
        self, chain: Sequence[_Joint], places: Mapping[str, LinkPlace]
    ) -> tuple[tuple[UrdfJoint, ...], Frame]:
        """Return the moving joints of the chain, each in the frame of the one before, and the tip in the last."""
        found, frame, masses = list[UrdfJoint](), AT_REST, self._masses(places)
        for joint in chain:
            frame = after(frame, self._origins.of(joint.element, f'joint "{joint.name}"'))
            if joint.moves:
                found.append(self._moving(joint, frame, masses.get(len(found) + 1, WEIGHTLESS)))
                frame = AT_REST
        return tuple(found), frame

    def _masses(self, places: Mapping[str, LinkPlace]) -> dict[int, Mass]:
        """Return what links weigh together, by the number of moving joints before them."""
        found: dict[int, Mass] = {}
        for link, (number, frame) in places.items():
            own = mass_of(self._links[link], f'link "{link}"', frame, self._origins, self._mistakes)
            found[number] = found.get(number, WEIGHTLESS) + own
        return found

    def places(self, chain: Sequence[_Joint], base: str) -> tuple[dict[str, LinkPlace], tuple[str, ...]]:
        """Return where the chain's links and those fixed to them are, and notes of what is left out."""
        places, number, frame = {base: (0, AT_REST)}, 0, AT_REST
        for joint in chain:
            frame = after(frame, self._origins.of(joint.element, f'joint "{joint.name}"'))
            if joint.moves:
                number, frame = number + 1, AT_REST
            places[joint.child] = (number, frame)
        on_chain, notes, waiting = {joint.name for joint in chain}, list[str](), list(places)
        while waiting:
            link = waiting.pop(0)
            number, frame = places[link]
            for joint in self._beside(link):
                other = joint.child if joint.parent == link else joint.parent
                if joint.name in on_chain or other in places:
                    continue
                if joint.moves:
                    what = "moves with" if other == joint.child else "carries"
                    notes.append(f'what {what} joint "{joint.name}" is left out')
                    continue
                origin = self._origins.of(joint.element, f'joint "{joint.name}"')
                places[other] = number, after(frame, origin if other == joint.child else inverse(origin))
                waiting.append(other)
        return places, tuple(notes)

    def bodies(
        self, places: Mapping[str, LinkPlace], shapes: Shapes
    ) -> tuple[tuple[UrdfBody, ...], tuple[str, ...]]:
        """Return bodies of links at their places, and notes of links that have none."""
        bodies, notes = list[UrdfBody](), list[str]()
        for link, (number, frame) in places.items():
            element = self._links[link]
            if not element.all("collision") and element.all("visual"):
                notes.append(f'link "{link}" has no collision shape')
            bodies += self._bodies(link, number, frame, shapes)
        bodies.sort(key=lambda body: body.joint)
        return tuple(bodies), tuple(notes)

    def visuals(self, places: Mapping[str, LinkPlace], shapes: Shapes) -> Iterator[UrdfVisual]:
        """Yield what is drawn of links at their places."""
        for link, (number, frame) in places.items():
            for visual in self._links[link].all("visual"):
                at = after(frame, self._origins.of(visual, f'link "{link}", <visual>'))
                yield from surfaces_of(visual, number, at, shapes, self._root)

    def _beside(self, link: str) -> list[_Joint]:
        """Return the joints of a link: to its children and to its parent."""
        above = self._above.get(link)
        return self._below[link] + ([] if above is None else [above])

    def _bodies(self, link: str, number: int, frame: Frame, shapes: Shapes) -> list[UrdfBody]:
        found = []
        for k, collision in enumerate(self._links[link].all("collision"), start=1):
            what = f'link "{link}", <collision>'
            origin, turn = after(frame, self._origins.of(collision, what))
            body = shapes.body(collision, what)
            if body is not None:
                points, radius = body
                name = link if k == 1 else f"{link}[{k}]"
                found.append(UrdfBody(name, number, origin + points @ turn.T, radius))
        return found

    def _moving(self, joint: _Joint, frame: Frame, mass: Mass) -> UrdfJoint:
        """Return a joint of the chain with its axis and limits."""
        axis = _axis(joint, self._mistakes)
        limits, rate, effort = _limits(joint, self._mistakes)
        kind = "prismatic" if joint.kind == "prismatic" else "revolute"
        return UrdfJoint(joint.name, kind, axis, *frame, limits, rate, effort, *mass, self._mimic(joint))

    def _named(self, tag: str) -> dict[str, Element]:
        """Return the links or joints by name."""
        found: dict[str, Element] = {}
        for element in self._root.all(tag):
            name = element.attributes.get("name", "").strip()
            if not name:
                self._mistakes.add(element, f"<{tag}> name", None, "a name")
            elif name in found:
                self._mistakes.add(element, f"<{tag}> name", name, f"a name that no other {tag} has")
            else:
                found[name] = element
        return found

    def _joint(self, name: str, element: Element) -> _Joint:
        what, kind = f'joint "{name}"', element.attributes.get("type")
        kinds, links = (*_MOVING, *_OTHER), list[str]()
        if kind not in kinds:
            self._mistakes.add(
                element, f"{what}, type", kind, f"one of {quoted(kinds)}{nearest(kind or '', kinds)}"
            )
        for tag in ("parent", "child"):
            inner = element.first(tag)
            link = None if inner is None else inner.attributes.get("link", "").strip()
            if link not in self._links:
                names = f"the name of a link{nearest(link or '', self._links)}"
                self._mistakes.add(inner or element, f"{what}, <{tag}>", link, names)
            links.append(link or "")
        if links[0] == links[1] and links[0] in self._links:
            self._mistakes.add(element, f"{what}, <child>", links[1], "another link than its parent")
        return _Joint(name, kind or "fixed", links[0], links[1], element)

    def _refuse_xacro(self) -> None:
        """Stop at the first trace of xacro, the language that URDF files are often generated from."""
        for element in self._root.walk():
            if element.tag.startswith("xacro:") or any("${" in text for text in element.attributes.values()):
                expected = "plain URDF: xacro has to be expanded first (xacro FILE > robot.urdf)"
                self._mistakes.add(element, "", f"<{element.tag}>", expected)
                self._mistakes.stop()

    def _refuse_loops(self) -> None:
        """Add the first joint of a closed loop, to which no root leads; here no link has two parents."""
        reached = [name for name in self._links if name not in self._above]
        for link in reached:
            reached += [joint.child for joint in self._below[link]]
        known = set(reached)
        for joint in self._joints:
            if joint.child not in known:
                expected = "joints that lead on from a link without a parent: closed loops are not served"
                self._mistakes.add(joint.element, f'joint "{joint.name}", <child>', joint.child, expected)
                return

    def _wrong(self, what: str, value: str | None, expected: str) -> None:
        self._mistakes.add(self._root, what, value, expected)


def _axis(joint: _Joint, mistakes: Mistakes) -> Array:
    """Return (3,) the unit vector along the axis of a joint, in its own frame."""
    what, given = f'joint "{joint.name}"', joint.element.first("axis")
    axis = (1.0, 0.0, 0.0) if given is None else mistakes.numbers(given, what, "xyz", 3, (1.0, 0.0, 0.0))
    length = 1.0 if axis is None else math.hypot(*axis)
    if given is not None and not length > 1e-9:
        mistakes.add(given, f"{what}, <axis> xyz", given.attributes["xyz"], "an axis that is not zero")
        length = 1.0
    return np.array(axis or (1.0, 0.0, 0.0)) / length


def _limits(
    joint: _Joint, mistakes: Mistakes
) -> tuple[tuple[float, float] | None, float | None, float | None]:
    """Return limits, rate and effort of a joint; zero rate or effort means no limit: None."""
    what, limit = f'joint "{joint.name}"', joint.element.first("limit")
    if limit is None:
        if joint.kind != "continuous":
            mistakes.add(joint.element, f"{what}, <limit>", None, "limits, lower and upper")
        return None, None, None
    most = []
    for key in ("velocity", "effort"):
        value = mistakes.numbers(limit, what, key, 1, (0.0,)) or (0.0,)
        if value[0] < 0.0:
            mistakes.add(limit, f"{what}, <limit> {key}", limit.attributes[key], "0 or more")
        most.append(value[0] if value[0] > 0.0 else None)
    if joint.kind == "continuous":
        return None, most[0], most[1]
    least, greatest = (mistakes.numbers(limit, what, key, 1, (0.0,)) for key in ("lower", "upper"))
    if least is not None and greatest is not None and not least[0] < greatest[0]:
        found = f"lower {least[0]:g}, upper {greatest[0]:g}"
        mistakes.add(limit, f"{what}, <limit>", found, "a lower limit below the upper one")
    return ((least or (-1.0,))[0], (greatest or (1.0,))[0]), most[0], most[1]
