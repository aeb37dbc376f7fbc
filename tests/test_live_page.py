"""The controls of the live page: each driven in a browser, and what they do to the session without one."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from queue import Queue
from time import monotonic
from typing import Any

import numpy as np
import pytest
from browser import CHROMIUM, FLAGS, PATIENCE

import vgtm_qp as vq
from vgtm_qp.live.journey import Journey
from vgtm_qp.live.obstacles import free_place
from vgtm_qp.live.page import Page
from vgtm_qp.live.readout import read_out
from vgtm_qp.live.session import Session

pytest.importorskip("viser")

from vgtm_qp.view.server import viser_server

PERIOD = 1.0 / 30.0
OF_VISER = "Unable to preventDefault inside passive event listener invocation."
"""What the browser says whenever a hand takes hold of a ball: viser's page listens to pointers passively. Harmless."""


@pytest.fixture
def session() -> Session:
    return Session(vq.load_problem("five_bay_two_cubes"))


def run(session: Session, frames: int) -> None:
    for _ in range(frames):
        session.advance(PERIOD)


def test_an_obstacle_that_comes_too_near_is_named_and_the_arm_at_rest_drives_away(session: Session):
    table, tip = session.obstacle("left cube"), session.tip
    session.move_obstacle(
        "left cube", center=np.add(table.center, [0.03, 0.0, 0.0]), rotation_vector=table.rotation_vector
    )
    reading = session.reading()
    worst = reading.too_near[0]
    assert "left cube" in worst.name
    assert worst.distance < worst.least == session.safe
    assert reading.hold is not None
    assert reading.hold.obstacle == "left cube"
    assert "too near" in read_out(session, "")
    run(session, 60)
    assert session.reading().too_near == ()
    assert session.reading().outcome == "at rest"
    assert np.allclose(session.tip, tip, atol=1e-6)
    assert session.clearance >= session.safe - 1e-9


def test_a_pose_nearer_than_the_new_safe_says_so_and_recovers(session: Session):
    tip = session.tip
    session.change({"clearance.safe": 0.12})
    assert session.safe == session.problem.clearance.safe == 0.12
    assert session.reading().too_near
    run(session, 120)
    assert not session.reading().too_near
    assert np.allclose(session.tip, tip, atol=1e-6)


def test_problem_and_drawing_follow_the_obstacles(session: Session):
    session.add_obstacle(vq.Sphere(name="ball", center=(2.0, 0.0, 1.0), radius=0.2))
    session.move_obstacle("ball", center=(2.5, 0.0, 1.0), rotation_vector=(0.0, 0.0, 0.0))
    session.remove_obstacle("right cube")
    assert [table.name for table in session.problem.obstacle] == ["left cube", "ball"]
    assert [mesh.name for mesh in session.drawing.obstacles] == ["left cube", "ball"]
    assert session.problem.obstacle[1].center == (2.5, 0.0, 1.0)
    assert session.drawing.obstacles[1].center.tolist() == [2.5, 0.0, 1.0]
    with pytest.raises(vq.GoalError, match="right cube"):
        session.obstacle("right cube")
    with pytest.raises(vq.GoalError, match="already"):
        session.add_obstacle(vq.Sphere(name="ball", center=(0.0, 9.0, 1.0), radius=0.2))
    # The scene goes with the arm to another method.
    session.use_method("pseudoinverse")
    assert [table.name for table in session.obstacles] == ["left cube", "ball"]


@pytest.mark.parametrize("name", ["five_bay_two_cubes", "five_bay_blocked_by_wall", "snake_past_a_cube"])
def test_a_new_obstacle_is_clear_of_everything(name: str):
    session = Session(vq.load_problem(name))
    for k in range(4):
        center = free_place(session, 0.3, 0.1)
        session.add_obstacle(vq.Sphere(name=f"ball {k}", center=tuple(center), radius=0.3))
        assert session.reading().too_near == ()
    run(session, 3)
    assert session.reading().outcome == "at rest"


def test_a_journey_arrives(session: Session):
    journey = Journey(session, session.tip + np.array([0.2, 0.1, -0.1]))
    frames = 0
    while not journey.is_over:
        session.advance(PERIOD)
        journey.watch(session)
        frames += 1
        assert frames < 500
    assert journey.said == "arrived at the goal"
    assert np.allclose(session.tip, journey.goal, atol=1e-3)


def test_a_journey_that_is_stopped_says_by_what_and_what_would_let_it_go_on():
    session = Session(vq.load_problem("five_bay_blocked_by_wall"))
    journey = Journey(session, np.array([2.0, 0.0, 3.0]))
    frames = 0
    while not journey.is_over:
        session.advance(PERIOD)
        journey.watch(session)
        frames += 1
        assert frames < 1000
    reading = session.reading()
    assert reading.outcome == "stopped"
    assert "mm from the goal" in journey.said
    assert "wall" in reading.why
    assert reading.hold is not None
    assert reading.hold.obstacle == "wall"
    # The line leads from the axis of that member to the wall.
    line, arm = reading.hold.line, session.drawing.arm
    (body,) = reading.hold.bodies
    assert np.linalg.norm(line[1] - line[0]) == pytest.approx(reading.hold.distance + arm.radius[body])
    ends = arm.ends(session.nodes)[body]
    beside = [np.linalg.norm(end - line[0]) for end in ends]
    assert sum(beside) == pytest.approx(np.linalg.norm(ends[1] - ends[0]), abs=1e-6)
    shown = read_out(session, "", journey.said)
    assert "id='why'" in shown
    assert "id='journey'" in shown
    # It rests until something is asked of it again.
    assert not session.advance(PERIOD)
    assert session.reading().outcome == "stopped"
    session.remove_obstacle("wall")
    journey = Journey(session, np.array([1.2, 0.0, 3.6]))
    run(session, 150)
    assert np.allclose(session.tip, [1.2, 0.0, 3.6], atol=1e-3)


def test_a_hand_that_asks_for_something_else_ends_a_journey(session: Session):
    journey = Journey(session, session.tip + np.array([0.5, 0.0, -0.1]))
    session.advance(PERIOD)
    journey.watch(session)
    assert not journey.is_over
    session.want_tip(session.tip)
    journey.watch(session)
    assert journey.is_over
    assert journey.said == ""


def test_every_bundled_problem_can_be_shown_after_another():
    with viser_server() as server:
        page = Page(server, Session(vq.load_problem("five_bay_free")), None)
        for name in vq.bundled_problems():
            page.post(lambda name=name: page.load(vq.load_problem(name)))
            page.read_inbox()
            assert page.message == "", name
            assert page.session.drawing.name == vq.load_problem(name).name
            page.draw()
        page.load(vq.load_problem("five_bay_free"))
        page.solve()
        page.play(0.5)
        assert page.message == ""
        assert page.moment > 0.0


class Live:
    """A page in a browser: its session, and what a hand does."""

    def __init__(self, tab: Any, server: Any, page: Page) -> None:
        self.tab, self.server, self.page = tab, server, page
        self.driven = 0

    def ask(self, question: Callable[[Session], Any]) -> Any:
        """Return what the loop of the page, to which the session belongs, answers between two frames."""
        answers: Queue[Any] = Queue()

        def answer() -> None:
            try:
                answers.put(question(self.page.session))
            except vq.VgtmError as error:
                answers.put(error)

        self.page.post(answer)
        return answers.get(timeout=PATIENCE)

    def wait(self, is_so: Callable[[Session], Any], why: str) -> None:
        """Wait until something is so of the session."""
        self.until(lambda: self.holds(is_so), why)

    def holds(self, is_so: Callable[[Session], Any]) -> bool:
        """Return whether something is so of the session now."""
        answer = self.ask(is_so)
        return bool(answer) and not isinstance(answer, vq.VgtmError)

    def until(self, is_so: Callable[[], Any], why: str) -> None:
        """Wait until something is so of what the page shows."""
        end = monotonic() + PATIENCE
        while not is_so():
            assert monotonic() < end, why
            self.tab.wait_for_timeout(50)

    def open(self, name: str) -> None:
        """Open a tab of the panel."""
        self.tab.get_by_role("tab", name=name, exact=True).click()
        self.driven += 1

    def press(self, name: str) -> None:
        """Press a button."""
        self.tab.get_by_role("button", name=name, exact=True).click()
        self.driven += 1

    def choose(self, value: str, label: str) -> None:
        """Choose a value of a drop-down."""
        self.field(label).click()
        self.tab.get_by_role("option", name=value, exact=True).click()
        self.driven += 1

    def field(self, label: str, part: int = 0) -> Any:
        """Return a field of the row with a label."""
        row = self.tab.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//input][1]")
        return row.locator("input:not([type=hidden])").nth(part)

    def enter(self, value: str, label: str, part: int = 0) -> None:
        """Enter a value into a field."""
        field = self.field(label, part)
        field.fill(value)
        field.press("Enter")
        field.blur()
        self.driven += 1

    def seen(self, text: str) -> None:
        """Wait until the page says something."""
        self.tab.get_by_text(text).first.wait_for()

    def pixel(self, place: Any) -> tuple[float, float]:
        """Return where a place, m, is on the screen."""
        (client,) = self.server.get_clients().values()
        camera = client.camera
        w, x, y, z = np.asarray(camera.wxyz, dtype=float)
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        seen = turn.T @ (np.asarray(place, dtype=float) - camera.position)
        box = self.tab.locator("canvas").first.bounding_box()
        focal = box["height"] / 2 / np.tan(camera.fov / 2)
        return (
            box["x"] + box["width"] / 2 + focal * seen[0] / seen[2],
            box["y"] + box["height"] / 2 + focal * seen[1] / seen[2],
        )

    def drag(
        self, start: Callable[[Session], Any], way: Any, is_so: Callable[[Session], Any], why: str
    ) -> None:
        """Drag what is at a place by a way, m; again, if the picture was not up to date, until something is so."""
        end, mouse = monotonic() + PATIENCE, self.tab.mouse
        while not self.holds(is_so):
            assert monotonic() < end, why
            self.tab.wait_for_timeout(300)
            place = self.ask(start)
            (x, y), (u, v) = self.pixel(place), self.pixel(np.add(place, way))
            mouse.move(x - 3, y - 3)
            mouse.move(x, y)
            self.tab.wait_for_timeout(300)
            mouse.down()
            for share in np.linspace(0.1, 1.0, 10):
                mouse.move(x + share * (u - x), y + share * (v - y))
                self.tab.wait_for_timeout(60)
            mouse.up()
            self.tab.wait_for_timeout(300)
        self.driven += 1


@pytest.fixture
def live() -> Iterator[Live]:
    """Give a page with its loop, opened in a browser that notes every error."""
    if not CHROMIUM.exists():
        pytest.skip(f"no browser: {CHROMIUM} is not there")
    playwright = pytest.importorskip("playwright.sync_api")
    stop = threading.Event()
    with viser_server() as server, playwright.sync_playwright() as driver:
        page = Page(server, Session(vq.load_problem("five_bay_two_cubes")), None)
        loop = threading.Thread(target=page.run, args=(stop,))
        loop.start()
        chromium = driver.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
        context = chromium.new_context(viewport={"width": 1280, "height": 900})
        context.set_default_timeout(1000.0 * PATIENCE)
        tab, errors = context.new_page(), []

        def note(said: Any) -> None:
            if said.type == "error" and said.text != OF_VISER:
                errors.append(said.text)

        tab.on("console", note)
        tab.on("pageerror", lambda error: errors.append(str(error)))
        try:
            tab.goto(f"http://127.0.0.1:{server.get_port()}")
            tab.get_by_text("at rest").wait_for()
            tab.locator(".mantine-Notification-closeButton").click()
            yield Live(tab, server, page)
            assert loop.is_alive()
            assert errors == []
        finally:
            stop.set()
            loop.join(timeout=PATIENCE)
            chromium.close()
        assert not loop.is_alive()


@pytest.mark.dear
def test_every_control_is_driven_without_an_error(live: Live):
    drive_obstacles(live)
    drive_carrying(live)
    drive_forces(live)
    drive_clearance_and_method(live)
    drive_moves(live)
    drive_maneuver(live)
    drive_problems(live)
    assert live.driven >= 30


def drive_obstacles(live: Live) -> None:
    """Add, choose, move, drag and delete obstacles."""

    def is_there(name: str) -> Callable[[Session], bool]:
        return lambda session: name in [table.name for table in session.obstacles]

    def is_gone(name: str) -> Callable[[Session], bool]:
        return lambda session: not is_there(name)(session)

    def center(name: str) -> Any:
        return live.ask(lambda session: np.array(session.obstacle(name).center))

    def shown(label: str, value: str) -> None:
        live.until(lambda: live.field(label).input_value() == value, f"{label} is not {value}")

    live.open("Obstacles")
    for shape in ("box", "sphere", "cylinder"):
        live.press(f"Add {shape}")
        live.wait(is_there(f"{shape} 1"), f"no {shape}")
        shown("obstacle", f"{shape} 1")
    live.press("Delete")
    live.wait(is_gone("cylinder 1"), "still there")
    live.choose("sphere 1", "obstacle")
    x = center("sphere 1")[0]
    live.until(lambda: abs(float(live.field("center [m]").input_value()) - x) < 0.01, "other coordinates")
    live.press("Delete")
    live.wait(is_gone("sphere 1"), "still there")
    live.choose("box 1", "obstacle")
    shown("obstacle", "box 1")
    live.enter("2.9", "center [m]", 2)
    live.wait(lambda session: session.obstacle("box 1").center[2] == 2.9, "not where it was typed")
    before = center("box 1")
    live.drag(
        lambda session: np.add(session.obstacle("box 1").center, [0.0, 0.0, 0.5]),
        [0.0, 0.0, -1.0],
        lambda session: session.obstacle("box 1").center[2] < before[2] - 0.3,
        "the gizmo drags nothing",
    )
    assert np.allclose(center("box 1")[:2], before[:2], atol=1e-3)
    live.press("Delete")
    live.wait(is_gone("box 1"), "still there")
    # An obstacle that is put too near says so, and the arm gives way.
    live.choose("left cube", "obstacle")
    x = center("left cube")[0]
    live.until(lambda: abs(float(live.field("center [m]").input_value()) - x) < 0.01, "other coordinates")
    live.enter(f"{x + 0.03:.3f}", "center [m]", 0)
    live.wait(lambda session: session.obstacle("left cube").center[0] > x + 0.02, "not moved")
    live.wait(lambda session: not session.reading().too_near, "still too near")
    live.enter(f"{x:.3f}", "center [m]", 0)
    live.wait(lambda session: abs(session.obstacle("left cube").center[0] - x) < 1e-3, "not moved back")
    live.choose("(none)", "obstacle")
    live.until(lambda: live.field("center [m]").is_disabled(), "still chosen")


def drive_clearance_and_method(live: Live) -> None:
    """Slide the least clearance, change the method and a weight."""
    live.open("Method")
    live.enter("0.12", "safe [m]")
    live.wait(lambda session: session.safe == 0.12, "another clearance")
    live.wait(lambda session: not session.reading().too_near, "still too near")
    slider = live.tab.get_by_role("slider").locator("visible=true").first
    slider.focus()
    slider.press("ArrowLeft")
    live.driven += 1
    live.wait(lambda session: abs(session.safe - 0.115) < 1e-9, "the slider does nothing")
    live.enter("0.08", "safe [m]")
    live.wait(lambda session: session.safe == 0.08, "another clearance")
    for method in ("pseudoinverse", "qp"):
        live.choose(method, "method")
        live.wait(lambda session, method=method: session.method == method, "another method")
    live.tab.get_by_text("Weights, powers of ten").click()
    live.driven += 1
    live.enter("-1", "actuator rate")
    live.wait(
        lambda session: abs(session.problem.method.weights.actuator_rate - 0.1) < 1e-9, "another weight"
    )


def drive_carrying(live: Live) -> None:
    """Carry an obstacle, move with it, and let it go."""
    live.press("Add sphere")
    live.wait(lambda session: session.obstacles[-1].name == "sphere 1", "no sphere")
    place = live.ask(lambda session: np.add(session.tip, [0.0, 0.0, 0.5]))
    live.page.post(
        lambda: live.page.session.move_obstacle("sphere 1", center=place, rotation_vector=[0.0, 0.0, 0.0])
    )
    live.press("Carry")
    live.wait(lambda session: session.carried == ("sphere 1",), "not carried")
    live.page.post(lambda: live.page.session.want_tip(np.add(live.page.session.tip, [0.2, 0.0, 0.0])))

    def is_with_the_tip(session: Session) -> bool:
        (mesh,) = (mesh for mesh in session.drawing.obstacles if mesh.name == "sphere 1")
        gap = mesh.position(session.state.time) - session.tip
        return bool(session.state.time > 0.0) and abs(float(np.linalg.norm(gap)) - 0.5) < 1e-9

    live.wait(is_with_the_tip, "the sphere is not where the tip is")
    live.press("Let go")
    live.wait(lambda session: session.carried == () and len(session.obstacles) == 3, "not let go")
    live.press("Delete")
    live.wait(lambda session: len(session.obstacles) == 2, "not deleted")


def drive_forces(live: Live) -> None:
    """Show what the members bear."""
    live.open("Forces")
    live.tab.get_by_text("Show forces").click()
    live.driven += 1
    live.seen("greatest push")
    live.enter("100", "force at the tip [N]", 2)
    live.seen("greatest pull")
    live.tab.get_by_text("Show forces").click()
    live.driven += 1
    live.open("Obstacles")


def drive_moves(live: Live) -> None:
    """Drag the tip and a control vertex, send the tip to goals, stop it, and go home."""
    tab = live.tab

    def go_home() -> None:
        live.press("Home")
        live.wait(lambda session: session.state.time == 0.0, "not at home")
        live.wait(lambda session: session.reading().outcome == "at rest", "not at rest")

    def tip() -> Any:
        return live.ask(lambda session: session.tip)

    live.open("Move")
    go_home()
    live.drag(
        lambda session: session.control_vertices[3].copy(),
        [0.0, 0.0, 0.2],
        lambda session: session.state.time > 0.0,
        "the vertex draws nothing",
    )
    before = tip()
    live.drag(
        lambda session: session.tip,
        [0.0, 0.0, -0.3],
        lambda session: np.linalg.norm(session.tip - before) > 0.02,
        "the tip stays",
    )
    go_home()
    goal = np.array([0.5, 0.0, 4.0])
    for part in range(3):
        live.enter(f"{goal[part]:g}", "goal [m]", part)
    live.wait(lambda _: np.allclose(live.page.goal, goal), "another goal")
    # The gizmo of the goal.
    live.drag(
        lambda _: np.add(live.page.goal, [0.0, 0.0, 0.39]),
        [0.0, 0.0, -0.3],
        lambda _: live.page.goal[2] < goal[2] - 0.1,
        "the goal is where it was",
    )
    live.press("Go there")
    live.seen("arrived at the goal")
    assert np.allclose(tip(), live.page.goal, atol=1e-3)
    live.enter("9", "goal [m]", 0)
    live.press("Go there")
    live.seen("mm from the goal")
    tab.locator("#why").wait_for()
    assert tab.locator("#stopped-by").inner_text()
    live.enter("-1.2", "goal [m]", 0)
    live.press("Go there")
    live.wait(lambda session: session.reading().outcome != "stopped", "not on its way")
    live.press("Stop")
    live.wait(lambda session: np.array_equal(session.target, session.tip), "not at rest")
    go_home()


def drive_maneuver(live: Live) -> None:
    """Solve, play, pause and scrub."""
    page, tab = live.page, live.tab
    live.open("Maneuver")
    live.press("Play")
    live.seen("nothing to play yet")
    live.press("Solve and play")
    live.until(lambda: page.moment > 0.0, "nothing is played")
    live.press("Pause")
    tab.get_by_role("button", name="Play", exact=True).wait_for()
    live.enter("1", "time [s]")
    live.until(lambda: abs(page.moment - 1.0) < 1e-9, "another moment")
    live.press("Play")
    live.until(lambda: page.moment > 1.0, "nothing is played")


def drive_problems(live: Live) -> None:
    """Choose other problems, with another kind of arm, and another camera."""
    live.open("Method")
    for name in ("snake_past_a_cube", "five_bay_free", "five_bay_two_cubes"):
        live.choose(name, "problem")
        wanted = vq.load_problem(name).name
        live.wait(lambda session, wanted=wanted: session.drawing.name == wanted, "another problem")
        live.until(lambda: live.page.message == "", "a notice")


def test_a_fault_in_a_callback_is_a_notice_and_the_page_goes_on(
    live: Live, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    def broken(*_: object) -> None:
        raise ZeroDivisionError("by design")

    with monkeypatch.context() as patch:
        patch.setattr(Session, "go_home", broken)
        live.press("Home")
        live.tab.locator("#notice").filter(has_text="ZeroDivisionError: by design").wait_for()
    assert "by design" in caplog.text
    assert "Traceback" in caplog.text
    # The same button works, and takes the notice away.
    live.press("Home")
    live.tab.locator("#notice").wait_for(state="detached")
    live.open("Obstacles")
    with monkeypatch.context() as patch:
        patch.setattr(Session, "add_obstacle", broken)
        live.press("Add box")
        live.tab.locator("#notice").filter(has_text="ZeroDivisionError").wait_for()
    live.press("Add box")
    live.wait(lambda session: len(session.obstacles) == 3, "no box")
    live.tab.locator("#notice").wait_for(state="detached")
