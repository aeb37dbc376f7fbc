"""A small arm as a URDF file, what may be wrong with such a file, and its kinematics straight from the XML."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

ARM = """<?xml version="1.0"?>
<robot name="small">
  <link name="base"><collision><geometry><box size="0.2 0.2 0.1"/></geometry></collision></link>
  <joint name="turn" type="continuous">
    <parent link="base"/><child link="column"/>
    <origin xyz="0 0 0.1" rpy="0.1 0 0"/><axis xyz="0 0 2"/><limit velocity="1.5" effort="20"/>
  </joint>
  <link name="column">
    <inertial><origin xyz="0 0 0.2" rpy="0 0 0"/><mass value="3"/>
      <inertia ixx="0.04" ixy="0" ixz="0" iyy="0.04" iyz="0" izz="0.004"/></inertial>
    <collision><origin xyz="0 0 0.2"/><geometry><cylinder radius="0.05" length="0.4"/></geometry></collision>
  </link>
  <joint name="mount" type="fixed">
    <parent link="column"/><child link="shoulder"/><origin xyz="0 0.02 0.4" rpy="0 0.2 0"/>
  </joint>
  <link name="shoulder"><inertial><mass value="1"/></inertial></link>
  <joint name="lift" type="revolute">
    <parent link="shoulder"/><child link="arm"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1.5" velocity="0.8" effort="50"/>
  </joint>
  <link name="arm">
    <collision><geometry><sphere radius="0.08"/></geometry></collision>
    <collision name="bar"><origin xyz="0.3 0 0" rpy="0 1.57 0"/>
      <geometry><capsule radius="0.04" length="0.5"/></geometry></collision>
  </link>
  <joint name="camera_mount" type="fixed">
    <parent link="arm"/><child link="camera"/><origin xyz="0.1 0 0.1"/>
  </joint>
  <link name="camera"><collision><geometry><box size="0.05 0.05 0.05"/></geometry></collision></link>
  <joint name="slide" type="prismatic">
    <parent link="arm"/><child link="rod"/>
    <origin xyz="0.5 0 0" rpy="0 0 0.3"/><axis xyz="1 0 0"/><limit lower="0.1" upper="0.4" velocity="0.2" effort="5"/>
  </joint>
  <link name="rod"/>
  <joint name="finger" type="prismatic">
    <parent link="rod"/><child link="jaw"/><axis xyz="0 1 0"/><limit lower="0" upper="0.1" velocity="0" effort="1"/>
    <mimic joint="slide"/>
  </joint>
  <link name="jaw"/>
  <joint name="flange" type="fixed">
    <parent link="rod"/><child link="tool"/><origin xyz="0.1 0 0" rpy="0 0 0.5"/>
  </joint>
  <link name="tool"/>
</robot>
"""

BROKEN: dict[str, tuple[str, str, str]] = {
    "cut": ("</robot>\n", "", "no element found"),
    "unclosed": ('<link name="rod"/>', '<link name="rod">', "mismatched tag"),
    "another root": ("robot", "sdf", "<robot>, the root"),
    "entities": ('<?xml version="1.0"?>', '<!DOCTYPE x [<!ENTITY a "b">]>', "no document type"),
    "xacro tag": ('<link name="rod"/>', '<xacro:rod name="rod"/>', "xacro"),
    "xacro value": ('radius="0.08"', 'radius="${r}"', "xacro"),
    "link without name": ('<link name="tool"/>', "<link/>", "<link> name"),
    "empty name": ('<link name="tool"/>', '<link name=" "/>', "<link> name"),
    "two links": ('<link name="rod"/>', '<link name="rod"/><link name="rod"/>', "no other link"),
    "joint without name": ('name="mount" type', "type", "<joint> name"),
    "two joints": ('joint name="mount"', 'joint name="turn"', "no other joint"),
    "no type": ('name="lift" type="revolute"', 'name="lift"', 'joint "lift", type'),
    "misspelt type": ('type="revolute"', 'type="revolut"', 'did you mean "revolute"'),
    "floating": ('name="lift" type="revolute"', 'name="lift" type="floating"', 'joint "lift", type: found "floating"'),
    "planar": ('name="slide" type="prismatic"', 'name="slide" type="planar"', 'joint "slide", type'),
    "no parent": ('<parent link="shoulder"/>', "", 'joint "lift", <parent>'),
    "no child": ('<child link="column"/>', "", 'joint "turn", <child>'),
    "parent without link": ('<parent link="shoulder"/>', "<parent/>", 'joint "lift", <parent>'),
    "unknown parent": ('<parent link="shoulder"/>', '<parent link="sholder"/>', 'did you mean "shoulder"'),
    "unknown child": ('<child link="column"/>', '<child link="colum"/>', 'did you mean "column"'),
    "its own child": ('<child link="rod"/>', '<child link="arm"/>', "another link than its parent"),
    "two parents": ('<child link="camera"/>', '<child link="shoulder"/>', "closed loops"),
    "all in a loop": (
        '<link name="tool"/>',
        '<link name="tool"/><joint name="x" type="fixed"><parent link="tool"/><child link="base"/></joint>',
        "closed loops",
    ),
    "two roots": ('<link name="tool"/>', '<link name="tool"/><link name="stone"/>', 'one of "base", "stone"'),
    "no links": (ARM[ARM.index("  <link") : ARM.index("</robot>")], "", "links"),
    "no axis": ('<axis xyz="0 1 0"/><limit lower="-1"', '<axis xyz="0 0 0"/><limit lower="-1"', "not zero"),
    "short axis": ('<axis xyz="0 0 2"/>', '<axis xyz="0 2"/>', "<axis> xyz"),
    "axis in words": ('<axis xyz="0 0 2"/>', '<axis xyz="0 0 up"/>', "<axis> xyz"),
    "axis nan": ('<axis xyz="0 0 2"/>', '<axis xyz="0 0 nan"/>', "finite"),
    "no limits": ('<limit lower="-1" upper="1.5" velocity="0.8" effort="50"/>', "", 'joint "lift", <limit>'),
    "slide without limits": ('<limit lower="0.1" upper="0.4" velocity="0.2" effort="5"/>', "", '"slide", <limit>'),
    "limits the wrong way": ('lower="-1" upper="1.5"', 'lower="2" upper="1.5"', "below the upper one"),
    "no room": ('lower="0.1" upper="0.4"', 'lower="0.4" upper="0.4"', "below the upper one"),
    "lower in words": ('lower="-1"', 'lower="low"', "<limit> lower"),
    "upper infinite": ('upper="1.5"', 'upper="inf"', "<limit> upper"),
    "upper twice": ('upper="1.5"', 'upper="1.5 2"', "<limit> upper"),
    "negative velocity": ('velocity="0.8"', 'velocity="-0.8"', "<limit> velocity"),
    "velocity in words": ('velocity="0.8"', 'velocity="fast"', "<limit> velocity"),
    "negative effort": ('effort="50"', 'effort="-50"', "<limit> effort"),
    "origin in words": ('xyz="0 0.02 0.4"', 'xyz="a b c"', '<origin> xyz'),
    "origin of four": ('xyz="0 0.02 0.4"', 'xyz="0 0.02 0.4 1"', '<origin> xyz'),
    "origin far away": ('xyz="0 0.02 0.4"', 'xyz="0 0.02 1e30"', '<origin> xyz'),
    "rpy of two": ('rpy="0 0.2 0"', 'rpy="0 0.2"', "<origin> rpy"),
    "rpy infinite": ('rpy="0 0.2 0"', 'rpy="0 inf 0"', "<origin> rpy"),
    "origin of a shape": ('<origin xyz="0 0 0.2"/>', '<origin xyz="0 0"/>', 'link "column", <collision>, <origin> xyz'),
    "origin of a camera": ('xyz="0.1 0 0.1"', 'xyz="0.1 0 x"', 'joint "camera_mount"'),
    "no radius": ('<sphere radius="0.08"/>', "<sphere/>", 'link "arm", <collision>, <sphere> radius'),
    "negative radius": ('<sphere radius="0.08"/>', '<sphere radius="-1"/>', "greater than 0"),
    "zero length": ('length="0.4"', 'length="0"', "<cylinder> length"),
    "cylinder without radius": ('<cylinder radius="0.05"', "<cylinder", "<cylinder> radius"),
    "capsule without length": ('<capsule radius="0.04" length="0.5"/>', '<capsule radius="0.04"/>', "<capsule> length"),
    "flat box": ('size="0.2 0.2 0.1"', 'size="0.2 0.2 0"', "<box> size"),
    "box of two": ('size="0.2 0.2 0.1"', 'size="0.2 0.2"', "<box> size"),
    "no geometry": ("<geometry><sphere radius=\"0.08\"/></geometry>", "", "<geometry>"),
    "empty geometry": ('<sphere radius="0.08"/>', "", "one of box"),
    "two shapes": ('<sphere radius="0.08"/>', '<sphere radius="0.08"/><sphere radius="0.1"/>', "one of box"),
    "unknown shape": ('<sphere radius="0.08"/>', '<cone radius="0.08"/>', "<cone>"),
    "mesh without name": ('<sphere radius="0.08"/>', "<mesh/>", "<mesh> filename"),
    "mesh that is not there": ('<sphere radius="0.08"/>', '<mesh filename="no.stl"/>', "there is none at"),
    "package not there": ('<sphere radius="0.08"/>', '<mesh filename="package://a/no.stl"/>', "there is none at"),
    "mesh that is a folder": ('<sphere radius="0.08"/>', '<mesh filename="."/>', "there is none at"),
    "mesh in another format": ('<sphere radius="0.08"/>', '<mesh filename="arm.urdf"/>', "STL, OBJ or DAE"),
    "mesh of nothing": ('<sphere radius="0.08"/>', '<mesh filename="empty.stl"/>', "<mesh> filename"),
    "scale of zero": ('<sphere radius="0.08"/>', '<mesh filename="wedge.stl" scale="1 0 1"/>', "<mesh> scale"),
    "scale of two": ('<sphere radius="0.08"/>', '<mesh filename="wedge.stl" scale="1 1"/>', "<mesh> scale"),
    "mimic of a fixed joint": ('<limit lower="-1"', '<mimic joint="mount"/><limit lower="-1"', "<mimic> joint"),
    "mimic of no joint": ('<limit lower="-1"', '<mimic joint="trun"/><limit lower="-1"', 'did you mean "turn"'),
    "mimic of itself": ('<limit lower="-1"', '<mimic joint="lift"/><limit lower="-1"', 'joint "lift", <mimic> joint'),
    "mimic without a name": ('<limit lower="-1"', '<mimic/><limit lower="-1"', "<mimic> joint"),
    "mimic times zero": (
        '<limit lower="-1"',
        '<mimic joint="turn" multiplier="0"/><limit lower="-1"',
        "<mimic> multiplier",
    ),
    "misspelt link": ('<link name="rod"/>', '<lnk name="rod"/>', "<lnk>"),
    "misspelt collision": (
        '<collision><geometry><sphere radius="0.08"/></geometry></collision>',
        '<colision><geometry><sphere radius="0.08"/></geometry></colision>',
        'link "arm": found "<colision>"',
    ),
    "misspelt axis": ('<axis xyz="0 0 2"/>', '<axes xyz="0 0 2"/>', 'joint "turn": found "<axes>"'),
    "misspelt limit": ('<limit lower="-1" upper', '<limt lower="-1" upper', 'found "<limt>"'),
    "misspelt upper": ('upper="1.5"', 'uper="1.5"', 'joint "lift", <limit>: found "uper"'),
    "misspelt xyz": ('xyz="0 0.02 0.4"', 'xzy="0 0.02 0.4"', '<origin>: found "xzy"'),
    "misspelt radius": ('<sphere radius="0.08"/>', '<sphere radus="0.08"/>', '<sphere>: found "radus"'),
    "two origins": ('<origin xyz="0 0 0.1" rpy', '<origin/><origin xyz="0 0 0.1" rpy', "one <origin> in a <joint>"),
    "two limits": ('<axis xyz="1 0 0"/>', '<axis xyz="1 0 0"/><limit lower="0" upper="1"/>', "one <limit>"),
    "two axes": ('<axis xyz="1 0 0"/>', '<axis xyz="1 0 0"/><axis xyz="0 1 0"/>', "one <axis>"),
    "digits with marks": ('xyz="0 0.02 0.4"', 'xyz="0 0.02 1_0"', "<origin> xyz"),
    "digits of others": ('xyz="0 0.02 0.4"', 'xyz="0 0.02 ١"', "<origin> xyz"),
    "no radius to speak of": ('<sphere radius="0.08"/>', '<sphere radius="1e-300"/>', "greater than 0"),
    "a loop beside the arm": (
        '<link name="tool"/>',
        '<link name="tool"/><link name="c"/><link name="d"/>'
        '<joint name="k" type="fixed"><parent link="c"/><child link="d"/></joint>'
        '<joint name="l" type="fixed"><parent link="d"/><child link="c"/></joint>',
        'joint "k", <child>: found "d"; expected joints that lead on',
    ),
    "no mass": ('<mass value="3"/>', "", 'link "column", <inertial>, <mass>: found nothing'),
    "mass without value": ('<mass value="3"/>', "<mass/>", "<mass> value"),
    "negative mass": ('<mass value="3"/>', '<mass value="-3"/>', "<mass> value: found \"-3\"; expected 0 or more"),
    "mass nan": ('<mass value="3"/>', '<mass value="nan"/>', "a finite number"),
    "two masses": ('<mass value="3"/>', '<mass value="3"/><mass value="1"/>', "one <mass> in a <inertial>"),
    "negative moment": ('izz="0.004"', 'izz="-0.004"', "<inertia> izz"),
    "no moment": ('izz="0.004"', "", "<inertia> izz"),
    "moment in words": ('ixy="0"', 'ixy="none"', "<inertia> ixy"),
    "centre in words": ('xyz="0 0 0.2" rpy="0 0 0"', 'xyz="0 0 c"', 'link "column", <inertial>, <origin> xyz'),
    "misspelt inertial": (
        '<inertial><mass value="1"/></inertial>',
        '<inertal><mass value="1"/></inertal>',
        'link "shoulder": found "<inertal>"',
    ),
    "package without a name": ('<sphere radius="0.08"/>', '<mesh filename="package:///a.stl"/>', "name of a package"),
}  # fmt: skip
"""By name: what of the file is replaced, by what, and a part of what is said."""


def placed(text: str, values: dict[str, float]) -> dict[str, np.ndarray]:
    """The (4, 4) frames of all links in that of the root, straight from the XML."""
    root = ElementTree.fromstring(text)
    joints = root.findall("joint")
    children = {joint.find("child").get("link") for joint in joints}
    frames = {
        link.get("name"): np.eye(4) for link in root.findall("link") if link.get("name") not in children
    }
    while len(frames) < len(root.findall("link")):
        for joint in joints:
            parent, child = joint.find("parent").get("link"), joint.find("child").get("link")
            if parent in frames and child not in frames:
                frames[child] = (
                    frames[parent] @ origin(joint) @ moved(joint, values.get(joint.get("name"), 0.0))
                )
    return frames


def origin(element: ElementTree.Element) -> np.ndarray:
    """The (4, 4) transform of an <origin>."""
    given, frame = element.find("origin"), np.eye(4)
    if given is not None:
        frame[:3, 3] = numbers(given.get("xyz", "0 0 0"))
        frame[:3, :3] = Rotation.from_euler("xyz", numbers(given.get("rpy", "0 0 0"))).as_matrix()
    return frame


def moved(joint: ElementTree.Element, value: float) -> np.ndarray:
    """The (4, 4) transform of a joint's motion."""
    given, frame = joint.find("axis"), np.eye(4)
    axis = np.array([1.0, 0.0, 0.0] if given is None else numbers(given.get("xyz")))
    axis = axis / np.linalg.norm(axis)
    if joint.get("type") == "prismatic":
        frame[:3, 3] = value * axis
    elif joint.get("type") != "fixed":
        frame[:3, :3] = Rotation.from_rotvec(value * axis).as_matrix()
    return frame


def numbers(text: str) -> list[float]:
    """The numbers of an attribute."""
    return [float(part) for part in text.split()]
