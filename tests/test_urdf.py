"""Serial arms from URDF files: kinematics, enclosing capsules, every kind of broken file, and whole problems."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from urdf_texts import ARM, BROKEN, placed

import vgtm_qp as vq
from vgtm_qp.arm.build import make_arm
from vgtm_qp.cli import main
from vgtm_qp.problem.urdf import read_urdf
from vgtm_qp.problem.urdf.shapes import enclosing_capsule

PROBLEM = """schema_version = 1
[arm]
urdf = "arm.urdf"
tip_link = "tool"
home = [0.1, 0.4, 0.2]
[curve]
control_vertices = 3
[maneuver]
steps = 5
waypoint = [{{ time = 5.0, position = [{}, {}, {}] }}]
"""


@pytest.fixture(autouse=True)
def _without_a_compiler(monkeypatch):
    monkeypatch.setenv("VGTM_CC", "none")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "arm.urdf").write_text(ARM)
    (tmp_path / "empty.stl").write_text("solid a\nendsolid a\n")
    trimesh.creation.box(extents=(0.1, 0.2, 0.3)).export(tmp_path / "wedge.stl")
    return tmp_path


def at(arm, values):
    """Origins and attitudes of the base, after each joint, and of the tip."""
    frames = [(np.zeros(3), np.eye(3))]
    for joint, value in zip(arm.joints, values, strict=True):
        origin, turn = frames[-1]
        origin, turn = origin + turn @ joint.position, turn @ joint.rotation
        if joint.kind == "prismatic":
            origin = origin + value * turn @ joint.axis
        else:
            turn = turn @ Rotation.from_rotvec(value * joint.axis).as_matrix()
        frames.append((origin, turn))
    origin, turn = frames[-1]
    return [*frames, (origin + turn @ arm.tip, turn @ arm.tip_rotation)]


def test_the_small_arm_is_read_as_it_stands(folder):
    arm = read_urdf(folder / "arm.urdf", tip_link="tool")
    assert [(j.name, j.kind, j.limits, j.rate, j.effort) for j in arm.joints] == [
        ("turn", "revolute", None, 1.5, 20.0),
        ("lift", "revolute", (-1.0, 1.5), 0.8, 50.0),
        ("slide", "prismatic", (0.1, 0.4), 0.2, 5.0),
    ]
    assert arm.joints[0].axis.tolist() == [0.0, 0.0, 1.0]
    # The column's 3 kg, and 1 kg of the shoulder that is fixed to it.
    assert [j.mass for j in arm.joints] == [4.0, 0.0, 0.0]
    np.testing.assert_allclose(arm.joints[0].center_of_mass, [0.0, 0.005, 0.25], atol=1e-15)
    assert [(body.name, body.joint) for body in arm.bodies] == [
        ("base", 0), ("column", 1), ("arm", 2), ("arm[2]", 2), ("camera", 2),
    ]  # fmt: skip
    assert arm.notes == ('what moves with joint "finger" is left out',)
    assert arm.bodies[2].points.tolist() == [[0.0, 0.0, 0.0]]
    assert arm.bodies[3].radius == 0.04
    np.testing.assert_allclose(np.ptp(arm.bodies[3].points, axis=0)[0], 0.5, atol=1e-6)


@settings(deadline=None, max_examples=30)
@given(values=st.tuples(*[st.floats(-3.0, 3.0)] * 3))
def test_joints_and_tip_are_where_the_file_puts_them(tmp_path_factory, values):
    file = tmp_path_factory.mktemp("urdf") / "arm.urdf"
    file.write_text(ARM)
    arm = read_urdf(file, tip_link="tool")
    frames = placed(ARM, dict(zip(("turn", "lift", "slide"), values, strict=True)))
    for (origin, turn), link in zip(at(arm, values), ("base", "column", "arm", "rod", "tool"), strict=True):
        np.testing.assert_allclose(origin, frames[link][:3, 3], atol=1e-12)
        np.testing.assert_allclose(turn, frames[link][:3, :3], atol=1e-12)


numbers = st.floats(-1.0, 1.0).map(lambda x: round(x, 6))
triples = st.tuples(numbers, numbers, numbers)


@st.composite
def chains(draw):
    """A random chain of moving and fixed joints with a body on every link and a branch that is fixed to one."""
    kinds = draw(
        st.lists(st.sampled_from(["revolute", "prismatic", "fixed", "continuous"]), min_size=1, max_size=7)
    )
    kinds.append("revolute")
    text = [link("l0")]
    for k, kind in enumerate(kinds):
        axis = draw(triples.filter(lambda axis: np.linalg.norm(axis) > 1e-3))
        limit = (
            '<limit lower="-1" upper="2" velocity="1" effort="1"/>'
            if kind in ("revolute", "prismatic")
            else ""
        )
        text.append(
            joint(
                f"j{k}",
                kind,
                f"l{k}",
                f"l{k + 1}",
                draw(triples),
                draw(triples),
                f'<axis xyz="{spaced(axis)}"/>{limit}',
            )
        )
        text.append(link(f"l{k + 1}"))
    text.append(
        joint("side", "fixed", f"l{draw(st.integers(0, len(kinds)))}", "extra", draw(triples), draw(triples))
    )
    text.append(link("extra"))
    names = [f"j{k}" for k, kind in enumerate(kinds) if kind != "fixed"]
    values = draw(st.tuples(*[st.floats(-2.0, 2.0)] * len(names)))
    return f'<robot name="r">{"".join(text)}</robot>', f"l{len(kinds)}", dict(zip(names, values, strict=True))


def link(name):
    return f'<link name="{name}"><collision><geometry><sphere radius="0.1"/></geometry></collision></link>'


def joint(name, kind, parent, child, xyz, rpy, more=""):
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}<origin xyz="{spaced(xyz)}" rpy="{spaced(rpy)}"/>{more}</joint>'


def spaced(values):
    return " ".join(map(str, values))


@pytest.mark.property
@settings(deadline=None, max_examples=60)
@given(chain=chains())
def test_random_chains_and_what_is_fixed_to_them_are_where_the_file_puts_them(tmp_path_factory, chain):
    text, tip, values = chain
    file = tmp_path_factory.mktemp("urdf") / "chain.urdf"
    file.write_text(text)
    arm = read_urdf(file, tip_link=tip)
    assert [j.name for j in arm.joints] == list(values)
    frames, wanted = at(arm, values.values()), placed(text, values)
    np.testing.assert_allclose(frames[-1][0], wanted[tip][:3, 3], atol=1e-11)
    np.testing.assert_allclose(frames[-1][1], wanted[tip][:3, :3], atol=1e-11)
    assert len(arm.bodies) == len(wanted)
    for body in arm.bodies:
        origin, turn = frames[body.joint]
        np.testing.assert_allclose(origin + turn @ body.points[0], wanted[body.name][:3, 3], atol=1e-11)


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_file_has_one_clear_mistake(what, folder):
    old, new, said = BROKEN[what]
    assert old in ARM, "the file has no such part"
    (folder / "arm.urdf").write_text(ARM.replace(old, new))
    with pytest.raises(vq.ProblemError) as raised:
        read_urdf(folder / "arm.urdf", tip_link="tool")
    assert len(raised.value.mistakes) == 1, raised.value
    assert said in str(raised.value)
    assert re.search(r"line \d+", str(raised.value))


def test_an_arm_without_collision_shapes_has_links_between_its_joints(folder):
    (folder / "arm.urdf").write_text(re.sub(r"<collision.*?</collision>", "", ARM, flags=re.DOTALL))
    problem = vq.load_problem(problem_file(folder))
    assert problem.arm.body is None
    assert vq.Resolver(problem).setup.arm.bodies.names == ("turn", "lift", "slide")
    assert vq.Resolver(problem.replace({"arm.body": []})).setup.arm.bodies.names == ("turn", "lift", "slide")


def test_a_mesh_is_found_in_a_package_whose_folder_has_another_name(folder):
    (folder / "robots").mkdir()
    (folder / "meshes").mkdir()
    (folder / "wedge.stl").rename(folder / "meshes/wedge.stl")
    mesh = '<mesh filename="package://small_support/meshes/wedge.stl"/>'
    (folder / "robots/arm.urdf").write_text(ARM.replace('<sphere radius="0.08"/>', mesh))
    arm = read_urdf(folder / "robots/arm.urdf", tip_link="tool")
    assert arm.files[1] == folder / "meshes/wedge.stl"


def test_there_are_sixty_kinds_of_them():
    assert len(BROKEN) >= 60


@pytest.mark.parametrize(
    ("links", "said"),
    [
        ({"tip_link": "tol"}, 'did you mean "tool"'),
        ({"base_link": "bas"}, 'did you mean "base"'),
        ({"base_link": "rod", "tip_link": "base"}, 'connect with the base, "rod"'),
        ({"base_link": "rod", "tip_link": "tool"}, "joints that move"),
        ({"base_link": "base", "tip_link": "base"}, "joints that move"),
    ],
)
def test_links_that_make_no_arm_are_refused_by_name(links, said, folder):
    with pytest.raises(vq.ProblemError, match=re.escape(said)) as raised:
        read_urdf(folder / "arm.urdf", **links)
    assert len(raised.value.mistakes) == 1


def test_without_a_tip_the_end_behind_most_joints_is_taken_if_there_is_one(folder):
    longest = read_urdf(folder / "arm.urdf")
    assert (longest.tip_link, longest.joints[-1].mimic) == ("jaw", ("slide", 1.0, 0.0))
    one = ARM.replace('<joint name="finger" type="prismatic">', '<joint name="finger" type="fixed">')
    (folder / "arm.urdf").write_text(one)
    with pytest.raises(vq.ProblemError, match=r'one of "jaw", "tool"'):
        read_urdf(folder / "arm.urdf")
    (folder / "arm.urdf").write_text(
        one.replace('<link name="jaw"/>', "").replace(
            one[one.index('  <joint name="finger"') : one.index('  <link name="jaw"/>')], ""
        )
    )
    assert read_urdf(folder / "arm.urdf").tip_link == "tool"


@pytest.mark.property
@settings(deadline=None, max_examples=60)
@given(points=st.lists(triples, min_size=1, max_size=40), stretch=triples)
def test_capsules_hold_the_points_they_are_made_for(points, stretch):
    points = np.array(points) * (0.01 + np.abs(stretch)) * 10.0
    ends, radius = enclosing_capsule(points)
    along = ends[-1] - ends[0]
    share = np.clip((points - ends[0]) @ along / max(along @ along, 1e-300), 0.0, 1.0)
    assert np.linalg.norm(points - ends[0] - share[:, None] * along, axis=1).max() <= radius * (1.0 + 1e-15)


@pytest.mark.parametrize(
    "shape", ['<cylinder radius="0.2" length="0.3"/>', '<cylinder radius="0.05" length="2"/>']
)
def test_a_capsule_round_a_cylinder_holds_its_rims_and_little_more(shape, folder):
    (folder / "arm.urdf").write_text(ARM.replace('<cylinder radius="0.05" length="0.4"/>', shape))
    body = read_urdf(folder / "arm.urdf", tip_link="tool", bodies="capsule").bodies[1]
    r, length = (float(x) for x in re.findall(r'"([\d.]+)"', shape))
    angle = np.linspace(0.0, 2.0 * np.pi, 400)
    rim = np.stack([r * np.cos(angle), r * np.sin(angle), np.zeros_like(angle)], axis=1)
    for end in (-0.5, 0.5):
        points = rim + np.array([0.0, 0.0, 0.2 + end * length])
        share = np.clip((points[:, 2] - body.points[0, 2]) / np.ptp(body.points[:, 2]), 0.0, 1.0)
        nearest = body.points[0] + share[:, None] * (body.points[1] - body.points[0])
        assert np.linalg.norm(points - nearest, axis=1).max() <= body.radius
    capsule = np.pi * body.radius**2 * (np.ptp(body.points[:, 2]) + 4.0 / 3.0 * body.radius)
    assert capsule < 1.9 * np.pi * r * r * length


def test_what_stands_for_a_shape_is_chosen(folder):
    cylinder = '<cylinder radius="0.05" length="0.4"/>'
    hull, primitives = (
        read_urdf(folder / "arm.urdf", tip_link="tool", bodies=kind).bodies for kind in ("hull", "primitives")
    )
    assert [body.points.tolist() for body in hull] == [body.points.tolist() for body in primitives]
    prism = hull[1].points - [0.0, 0.0, 0.2]
    aside = np.linalg.norm(prism[:, :2], axis=1)
    assert (aside > 0.05).all()
    assert (aside < 0.05 * 1.01).all()
    assert np.ptp(prism[:, 2]) == pytest.approx(0.4)
    # The prism holds the cylinder: the middles of its sides are on it.
    rim = np.array([x for x in prism if x[2] < 0.0])[:, :2]
    assert np.linalg.norm(rim + np.roll(rim, 1, axis=0), axis=1) / 2.0 == pytest.approx(0.05)
    assert (hull[2].points.tolist(), hull[2].radius) == ([[0.0, 0.0, 0.0]], 0.08)
    (folder / "arm.urdf").write_text(ARM.replace(cylinder, '<mesh filename="wedge.stl"/>'))
    with pytest.raises(vq.ProblemError, match="takes no meshes"):
        read_urdf(folder / "arm.urdf", tip_link="tool", bodies="primitives")


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("wedge.stl", "wedge.stl"),
        ("file://wedge.stl", "wedge.stl"),
        ("package://robot/wedge.stl", "robot/wedge.stl"),
        ("package://robot/wedge.stl", "packages/robot/wedge.stl"),
        ("package://robot/wedge.stl", "packages/wedge.stl"),
        ("package://robot/a%20b.stl", "robot/a b.stl"),
    ],
)
def test_meshes_are_found_and_enclosed(name, place, folder):
    source, target = folder / "wedge.stl", folder / place
    target.parent.mkdir(parents=True, exist_ok=True)
    source.rename(target)
    mesh = f'<mesh filename="{name}" scale="2 1 1"/>'
    (folder / "arm.urdf").write_text(ARM.replace('<sphere radius="0.08"/>', mesh))
    of = {"tip_link": "tool", "package_path": [folder / "packages"]}
    arm, hulls = (read_urdf(folder / "arm.urdf", **of, bodies=kind) for kind in ("capsule", "hull"))
    body, hull = (
        next(body for body in bodies if body.name == "arm") for bodies in (arm.bodies, hulls.bodies)
    )
    assert arm.files == hulls.files == (folder / "arm.urdf", target)
    corners = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T * [0.1, 0.1, 0.15]
    np.testing.assert_allclose(np.sort(hull.points, axis=0), np.sort(corners, axis=0), atol=1e-7)
    assert hull.radius == 0.0
    along = body.points[1] - body.points[0]
    share = np.clip((corners - body.points[0]) @ along / (along @ along), 0.0, 1.0)
    assert np.linalg.norm(corners - body.points[0] - share[:, None] * along, axis=1).max() <= body.radius


def problem_file(folder, offset=(0.0, 0.02, -0.02)):
    arm = read_urdf(folder / "arm.urdf", tip_link="tool")
    tip = at(arm, (0.1, 0.4, 0.2))[-1][0] + offset
    file = folder / "problem.toml"
    file.write_text(PROBLEM.format(*tip))
    return file


def test_a_problem_with_a_urdf_is_solved_and_its_result_stands_on_its_own(folder):
    problem = vq.load_problem(problem_file(folder))
    frames = placed(ARM, {"turn": 0.1, "lift": 0.4, "slide": 0.2})
    resolver = vq.Resolver(problem)
    position, rotation = resolver.tip()
    np.testing.assert_allclose(position, frames["tool"][:3, 3], atol=1e-12)
    np.testing.assert_allclose(rotation, frames["tool"][:3, :3], atol=1e-12)
    maneuver = vq.solve(problem)
    assert maneuver.status == "solved", str(maneuver.certificate)
    assert maneuver.joint_names.tolist() == ["turn", "lift", "slide"]
    maneuver.save(folder / "result.npz")
    (folder / "arm.urdf").unlink()
    assert vq.verify_file(folder / "result.npz").ok


def test_another_arm_is_read_where_a_key_that_says_which_is_changed(folder):
    problem = vq.load_problem(problem_file(folder))
    other = problem.replace({"arm.home": [0.0, 0.2, 0.3]})
    assert make_arm(other).home_quantities.tolist() == [0.0, 0.2, 0.3]
    assert problem.replace({"maneuver.steps": 7}).arm == problem.arm
    with pytest.raises(vq.ProblemError, match="3 joint values: turn, lift, slide"):
        problem.replace({"arm.home": [0.0]})


def test_a_result_is_held_against_the_urdf_of_another_problem(folder):
    maneuver = vq.solve(vq.load_problem(problem_file(folder)))
    (folder / "arm.urdf").write_text(
        ARM.replace('xyz="0.5 0 0" rpy="0 0 0.3"', 'xyz="0.5 0 0.01" rpy="0 0 0.3"')
    )
    certificate = vq.verify(maneuver, problem=vq.load_problem(problem_file(folder)))
    assert any("joint slide" in line or 'slide").position' in line for line in certificate.contradictions)


@pytest.mark.parametrize(
    ("line", "key", "said"),
    [
        ('urdf = "amr.urdf"', "arm.urdf", 'did you mean "arm.urdf"'),
        ("urdf = 3", "arm.urdf", ""),
        ('urdf = "arm.urdf"\njoint = []', "arm.joint", "no such key beside urdf"),
        ('urdf = "arm.urdf"\nbodies = "mesh"', "arm.bodies", "capsule"),
        ('urdf = "arm.urdf"\nbase_link = 3', "arm.base_link", "a name"),
    ],
)
def test_wrong_keys_of_an_arm_from_a_file_are_named(line, key, said, folder):
    file = problem_file(folder)
    file.write_text(file.read_text().replace('urdf = "arm.urdf"', line))
    with pytest.raises(vq.ProblemError) as raised:
        vq.load_problem(file)
    assert any(mistake.key.startswith(key) for mistake in raised.value.mistakes), raised.value
    assert said in str(raised.value)


def test_mistakes_of_the_urdf_are_those_of_the_problem(folder):
    file = problem_file(folder)
    (folder / "arm.urdf").write_text(ARM.replace('lower="-1" upper="1.5"', 'lower="2" upper="1.5"'))
    with pytest.raises(vq.ProblemError) as raised:
        vq.load_problem(file)
    (mistake,) = raised.value.mistakes
    assert mistake.value == '"lower 2, upper 1.5"'
    assert mistake.key == 'arm.urdf, line 19, joint "lift", <limit>'
    (folder / "robots").mkdir()
    (folder / "arm.urdf").rename(folder / "robots/small.urdf")
    file.write_text(
        file.read_text().replace('"arm.urdf"', '"robots/small.urdf"') + "[clearance]\nsafe = -1\n"
    )
    with pytest.raises(vq.ProblemError) as raised:
        vq.load_problem(file)
    assert [mistake.key for mistake in raised.value.mistakes] == [
        'robots/small.urdf, line 19, joint "lift", <limit>',
        "clearance.safe",
    ]


def test_joints_without_velocity_are_told(folder, capsys):
    text = ARM.replace('velocity="0.8"', 'velocity="0"').replace(' velocity="1.5"', "")
    (folder / "arm.urdf").write_text(text)
    assert main(["check", str(problem_file(folder))]) == 0
    assert "joints turn, lift may move at any rate" in capsys.readouterr().err
    (folder / "arm.urdf").write_text(ARM)
    assert main(["check", str(problem_file(folder))]) == 0
    assert "rate" not in capsys.readouterr().err


def test_a_joint_too_weak_for_the_arm_s_weight_is_told(folder, capsys):
    heavy = '<link name="camera"><inertial><mass value="100"/></inertial>'
    (folder / "arm.urdf").write_text(ARM.replace('<link name="camera">', heavy))
    assert main(["check", str(problem_file(folder))]) == 0
    told = capsys.readouterr()
    (line,) = (line for line in told.err.splitlines() if "effort" in line)
    assert 'arm.joint[1] ("lift").effort: found 50.0; expected' in line
    assert "which joint lift bears at home" in line
    assert "104 kg" in told.out
    frames = placed(ARM, {"turn": 0.1, "lift": 0.4, "slide": 0.2})
    lever = frames["camera"][:3, 3] - frames["arm"][:3, 3]
    borne = abs(np.cross(lever, [0.0, 0.0, -981.0]) @ frames["arm"][:3, 1])
    assert f"expected {borne:.4g} or more" in line


def test_keys_of_a_urdf_are_refused_without_one():
    with pytest.raises(vq.ProblemError, match=r"arm\.home.*no such key without urdf"):
        vq.load_problem("snake_past_a_cube").replace({"arm.home": [0.1] * 20})


def test_a_tip_without_a_body_of_its_own_may_come_to_an_obstacle(folder):
    problem = vq.load_problem(problem_file(folder))
    ball = {"name": "ball", "shape": "sphere", "center": [0.9, 0.3, 0.3], "radius": 0.05}
    assert vq.solve(problem.replace({"obstacle": [ball]})).status == "solved"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
def test_no_file_is_read_that_a_result_names(folder):
    maneuver = vq.solve(vq.load_problem(problem_file(folder)))
    data = json.loads(json.dumps(maneuver.manifest))
    # Nobody writes into this pipe: reading it would never end.
    os.mkfifo(folder / "pipe.urdf")
    data["problem"]["arm"]["urdf"] = str(folder / "pipe.urdf")
    assert any("was altered" in line for line in vq.verify(replace(maneuver, manifest=data)).contradictions)
    (folder / "arm.urdf").write_text("no robot")
    data["problem"]["arm"]["urdf"] = str(folder / "arm.urdf")
    del data["problem"]["arm"]["joint"]
    altered = vq.verify(replace(maneuver, manifest=data)).contradictions
    assert any("joints of the arm record" in line for line in altered)


def test_what_is_no_problem_is_refused_before_anything_is_certified():
    with pytest.raises(vq.ProblemError, match="load_problem"):
        vq.certify("arm.toml", [0.0], [[0.0]])


def test_what_is_fixed_to_the_base_from_above_belongs_to_the_arm(folder):
    table = """<link name="table"><collision><geometry><box size="1 1 0.1"/></geometry></collision></link>
      <joint name="legs" type="fixed"><parent link="table"/><child link="base"/>
        <origin xyz="0.2 0 0.3" rpy="0 0 0.4"/></joint>
      <link name="lamp"><collision><geometry><sphere radius="0.1"/></geometry></collision></link>
      <joint name="clamp" type="fixed"><parent link="table"/><child link="lamp"/><origin xyz="0 0.4 0.5"/></joint>
      <link name="rail"/>
      <joint name="trolley" type="prismatic"><parent link="rail"/><child link="table"/>
        <limit lower="0" upper="1"/></joint></robot>"""
    text = ARM.replace("</robot>", table)
    (folder / "arm.urdf").write_text(text)
    arm = read_urdf(folder / "arm.urdf", base_link="base", tip_link="tool")
    frames = placed(text, {})
    lamp = np.linalg.solve(frames["base"], frames["lamp"])[:3, 3]
    found = {body.name: body for body in arm.bodies}
    assert found["table"].joint == found["lamp"].joint == 0
    np.testing.assert_allclose(found["lamp"].points[0], lamp, atol=1e-12)
    assert 'what carries joint "trolley" is left out' in arm.notes


def test_thousands_of_mistakes_are_told_in_a_hundred(folder):
    links = "".join(f'<link name="l{k}"/>' for k in range(2001))
    joints = "".join(
        f'<joint name="j{k}" type="fixed"><parent link="m{k}"/><child link="l{k + 1}"/></joint>'
        for k in range(2000)
    )
    (folder / "arm.urdf").write_text(f'<robot name="r">{links}{joints}</robot>')
    with pytest.raises(vq.ProblemError) as raised:
        read_urdf(folder / "arm.urdf")
    assert len(raised.value.mistakes) == 100


COLLADA = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="{unit}" name="u"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="s"><float_array id="a" count="12">0 0 0 1 0 0 0 1 0 0 0 1</float_array><technique_common>
<accessor source="#a" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#s"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2 0 1 3 0 2 3 1 2 3</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="c"><node id="n"><instance_geometry url="#g"/>{more}</node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#c"/></scene></COLLADA>"""


@pytest.mark.parametrize("unit", [1.0, 0.0254, 100.0])
def test_collada_is_read_in_its_unit(unit, folder):
    pytest.importorskip("collada")
    (folder / "part.dae").write_text(COLLADA.format(unit=unit, more=""))
    (folder / "arm.urdf").write_text(ARM.replace('<sphere radius="0.08"/>', '<mesh filename="part.dae"/>'))
    body = read_urdf(folder / "arm.urdf", tip_link="tool", bodies="capsule").bodies[2]
    corners = unit * np.vstack([np.zeros(3), np.eye(3)])
    along = body.points[-1] - body.points[0]
    share = np.clip((corners - body.points[0]) @ along / max(along @ along, 1e-300), 0.0, 1.0)
    assert np.linalg.norm(corners - body.points[0] - share[:, None] * along, axis=1).max() <= body.radius
    assert body.radius < unit


@pytest.mark.parametrize(
    ("unit", "more"), [("1", '<instance_geometry url="#gone"/>'), ("0", ""), ("-1", ""), ("much", "")]
)
def test_collada_of_which_a_part_or_the_unit_is_missing_is_refused(unit, more, folder):
    pytest.importorskip("collada")
    (folder / "part.dae").write_text(COLLADA.format(unit=unit, more=more))
    (folder / "arm.urdf").write_text(ARM.replace('<sphere radius="0.08"/>', '<mesh filename="part.dae"/>'))
    with pytest.raises(vq.ProblemError, match=r"STL, OBJ or DAE") as raised:
        read_urdf(folder / "arm.urdf", tip_link="tool")
    assert len(raised.value.mistakes) == 1


def test_collada_names_what_it_takes(folder, monkeypatch):
    monkeypatch.setattr("vgtm_qp.problem.urdf.shapes.find_spec", lambda _: None)
    (folder / "part.dae").write_text(COLLADA.format(unit=1, more=""))
    (folder / "arm.urdf").write_text(ARM.replace('<sphere radius="0.08"/>', '<mesh filename="part.dae"/>'))
    with pytest.raises(vq.ProblemError, match=r"pip install 'vgtm-qp\[dae\]'"):
        read_urdf(folder / "arm.urdf", tip_link="tool")
