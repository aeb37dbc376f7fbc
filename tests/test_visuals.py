"""What a URDF file draws of an arm's links: read, put into place, and left out where the file is gone or another."""

from __future__ import annotations

import re
import threading
from pathlib import Path
from time import monotonic
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from browser import CHROMIUM, FLAGS, PATIENCE
from scipy.spatial.transform import Rotation
from urdf_texts import ARM, placed

import vgtm_qp as vq
from vgtm_qp.export.html import html_text
from vgtm_qp.live.page import Page
from vgtm_qp.live.session import Session
from vgtm_qp.problem.urdf import read_urdf, read_visuals
from vgtm_qp.view.drawing import drawing_of_maneuver
from vgtm_qp.view.links import LinkScene

SHAPES = {
    "base": '<box size="0.2 0.3 0.1"/>',
    "column": '<cylinder radius="0.05" length="0.4"/>',
    "shoulder": '<sphere radius="0.08"/>',
    "arm": '<capsule radius="0.04" length="0.5"/>',
    "camera": '<mesh filename="wedge.stl" scale="1 2 1"/>',
    "rod": '<mesh filename="gone.stl"/>',
    "tool": "<box/>",
}
"""By link: its visual shape. The last two cannot be drawn."""
SIZES = {
    "base": [0.2, 0.3, 0.1],
    "column": [0.1, 0.1, 0.4],
    "shoulder": [0.16] * 3,
    "arm": [0.08, 0.08, 0.58],
    "camera": [0.1, 0.4, 0.3],
}
MATERIAL = '<material name="paint"/>'
AT = '<origin xyz="0.01 0.02 0.03" rpy="0.1 0.2 0.3"/>'


def with_visuals() -> str:
    """Return the small arm with a visual for each link; the arm's and the camera's have colours."""
    text = ARM.replace("</robot>", '<material name="paint"><color rgba="0.1 0.2 0.3 1"/></material></robot>')
    for link, shape in SHAPES.items():
        look = {"arm": MATERIAL, "camera": '<material name=""><color rgba="1 0.5 0 1"/></material>'}.get(
            link, ""
        )
        visual = f"<visual>{AT}<geometry>{shape}</geometry>{look}</visual>"
        text = re.sub(rf'<link name="{link}"\s*/>', f'<link name="{link}"></link>', text)
        text = text.replace(f'<link name="{link}">', f'<link name="{link}">{visual}', 1)
    return text


@pytest.fixture
def folder(tmp_path: Path, monkeypatch) -> Path:
    monkeypatch.setenv("VGTM_CC", "none")
    (tmp_path / "arm.urdf").write_text(with_visuals())
    trimesh.creation.box(extents=(0.1, 0.2, 0.3)).export(tmp_path / "wedge.stl")
    return tmp_path


@pytest.fixture
def problem(folder) -> vq.Problem:
    table = {"urdf": str(folder / "arm.urdf"), "tip_link": "tool", "home": [0.1, 0.4, 0.2]}
    probe = vq.Problem(arm=table, maneuver={"waypoint": [{"time": 1.0, "position": [0.5, 0.0, 0.5]}]})
    tip = vq.Resolver(probe).tip()[0] + [0.0, 0.02, -0.02]
    return probe.replace(
        {"maneuver.waypoint": [{"time": 1.0, "position": tip.tolist()}], "maneuver.steps": 3}
    )


def test_visual_shapes_have_their_sizes_and_colours_and_are_where_the_file_puts_them(folder, problem):
    _, surfaces = read_visuals(folder / "arm.urdf", tip_link="tool")
    assert [surface.joint for surface in surfaces] == [0, 1, 1, 2, 2]
    looks = [surface.colour for surface in surfaces]
    assert looks[3:] == [(0.1, 0.2, 0.3), (1.0, 0.5, 0.0)]
    assert len(set(looks[:3])) == 1
    values = {"turn": 0.7, "lift": -0.4, "slide": 0.3}
    frames = placed(ARM, values)
    arm = Session(problem).drawing.arm
    moved = arm.along(np.array([[*values.values(), *[0.0] * 6]]))[2]
    offset = placed(f'<robot><link name="a"/><link name="b"/><joint name="j" type="fixed"><parent link="a"/>'
                    f'<child link="b"/>{AT}</joint></robot>', {})["b"]  # fmt: skip
    for surface, (link, size) in zip(surfaces, SIZES.items(), strict=True):
        origin, attitude = moved[surface.joint]
        points = origin[0] + surface.vertices @ attitude[0].T
        back = np.linalg.inv(frames[link] @ offset)
        own = points @ back[:3, :3].T + back[:3, 3]
        np.testing.assert_allclose([own.min(axis=0), own.max(axis=0)], np.outer([-0.5, 0.5], size), atol=2e-3)


def test_what_cannot_be_drawn_is_no_mistake_of_the_file(folder):
    (folder / "wedge.stl").write_bytes(b"no mesh")
    assert len(read_urdf(folder / "arm.urdf", tip_link="tool").bodies) == 5
    assert len(read_visuals(folder / "arm.urdf", tip_link="tool")[1]) == 4


def test_links_are_drawn_while_the_file_is_that_of_the_arm(folder, problem):
    maneuver = vq.solve(problem)
    assert len(drawing_of_maneuver(maneuver).links()) == 5
    text = (folder / "arm.urdf").read_text()
    (folder / "arm.urdf").write_text(
        text.replace('xyz="0.5 0 0" rpy="0 0 0.3"', 'xyz="0.5 0 0.01" rpy="0 0 0.3"')
    )
    assert drawing_of_maneuver(maneuver).links() == ()
    (folder / "arm.urdf").write_text("no robot")
    assert drawing_of_maneuver(maneuver).links() == ()
    (folder / "arm.urdf").unlink()
    assert drawing_of_maneuver(maneuver).links() == ()


def test_the_offline_page_has_links_with_the_file_and_bodies_without_it(folder, problem):
    pytest.importorskip("viser")
    maneuver = vq.solve(problem)
    drawn = html_text(maneuver)
    (folder / "arm.urdf").unlink()
    assert len(html_text(maneuver)) < len(drawn)


class Handles:
    """A scene that notes what is added to it."""

    def __init__(self) -> None:
        self.frames: dict[str, SimpleNamespace] = {}
        self.meshes: list[str] = []

    def add_frame(self, name: str, **_: object) -> SimpleNamespace:
        return self.frames.setdefault(name, SimpleNamespace(visible=True))

    def add_mesh_simple(self, name: str, *_: object, **__: object) -> None:
        self.meshes.append(name)


def test_links_move_with_the_joints_and_can_be_hidden(problem):
    drawing, handles = Session(problem).drawing, Handles()
    scene = LinkScene(handles, drawing.arm, drawing.links())
    assert [name.rpartition("/")[0] for name in handles.meshes] == [f"/links/{k}" for k in (0, 1, 1, 2, 2)]
    q = np.array([0.3, -0.2, 0.25, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    moved = drawing.arm.along(q[None])[2]
    for resolution in (0.0, 2.0**-12):
        scene.move(q, resolution)
        for k in range(3):
            frame, (origin, attitude) = handles.frames[f"/links/{k}"], moved[k]
            np.testing.assert_allclose(frame.position, origin[0], atol=1e-6 + resolution)
            turned = Rotation.from_quat(np.roll(frame.wxyz, -1)).as_matrix()
            np.testing.assert_allclose(turned, attitude[0], atol=1e-6 + 4.0 * resolution)
    scene.show(False)
    assert not any(frame.visible for frame in handles.frames.values())


@pytest.mark.dear
@pytest.mark.skipif(not CHROMIUM.exists(), reason=f"no browser: {CHROMIUM} is not there")
def test_on_the_page_links_give_way_to_bodies(problem):
    pytest.importorskip("viser")
    playwright = pytest.importorskip("playwright.sync_api")
    from vgtm_qp.view.server import viser_server

    stop = threading.Event()
    with viser_server() as server, playwright.sync_playwright() as driver:
        page = Page(server, Session(problem), None)
        loop = threading.Thread(target=page.run, args=(stop,))
        loop.start()
        chromium = driver.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
        tab = chromium.new_page(viewport={"width": 1000, "height": 800})
        tab.set_default_timeout(1000.0 * PATIENCE)
        try:
            tab.goto(f"http://127.0.0.1:{server.get_port()}")
            tab.get_by_text("at rest").wait_for()
            tab.locator(".mantine-Notification-closeButton").click()
            seen = set()
            for look in ("bodies", "links and bodies", "links"):
                tab.get_by_role("combobox", name="show").click()
                tab.get_by_role("option", name=look, exact=True).click()
                end = monotonic() + PATIENCE
                while (picture := tab.locator("canvas").first.screenshot()) in seen:
                    assert monotonic() < end, f"{look} look like the others"
                    tab.wait_for_timeout(300)
                seen.add(picture)
            assert not page.message
        finally:
            stop.set()
            loop.join(timeout=PATIENCE)
            chromium.close()
