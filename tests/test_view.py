"""The live page: the hand's session by itself, and the page in a browser without a network."""

from __future__ import annotations

import io
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import Queue
from time import monotonic
from typing import Any

import numpy as np
import pytest
from browser import CHROMIUM, FLAGS, PATIENCE
from numpy.typing import NDArray
from PIL import Image

import vgtm_qp as vq
from vgtm_qp.live.page import view
from vgtm_qp.live.readout import read_out
from vgtm_qp.live.session import Session
from vgtm_qp.methods import method_name, methods_for

PERIOD = 1.0 / 30.0
SCENE_WIDTH = 600


@pytest.fixture(scope="module")
def problem() -> vq.Problem:
    return vq.load_problem("five_bay_two_cubes")


@pytest.fixture(scope="module")
def maneuver(problem: vq.Problem) -> vq.Maneuver:
    return vq.solve(problem.replace({"maneuver.steps": 20}))


@pytest.fixture
def session(problem: vq.Problem) -> Session:
    return Session(problem)


@pytest.mark.smoke
def test_the_tip_goes_where_it_is_wanted_and_rests_there(session: Session):
    goal = session.tip + np.array([0.2, 0.1, -0.1])
    session.want_tip(goal)
    for _ in range(60):
        session.advance(PERIOD)
    assert np.allclose(session.tip, goal, atol=1e-4)
    assert not session.advance(PERIOD)
    assert session.reading().outcome == "at rest"


def test_no_state_on_the_way_breaks_a_limit(session: Session):
    drawing, safe = session.drawing, session.problem.clearance.safe
    session.want_tip(session.tip + np.array([1.4, 0.4, -0.9]))
    before = session.state.quantities
    for _ in range(80):
        session.advance(PERIOD)
        lengths = session.state.quantities
        low, high = drawing.arm.stroke.T
        assert np.all(lengths >= low - 1e-9)
        assert np.all(lengths <= high + 1e-9)
        assert np.all(np.abs(lengths - before)[drawing.arm.actuated] <= 0.5 * PERIOD + 1e-9)
        assert session.reading().clearance >= safe - 1e-9
        before = lengths


@pytest.mark.smoke
def test_a_way_through_an_obstacle_is_refused_and_the_obstacle_named():
    session = Session(vq.load_problem("five_bay_blocked_by_wall"))
    session.want_tip(np.array([2.0, 0.0, 3.0]))
    seen = set()
    for _ in range(150):
        session.advance(PERIOD)
        reading = session.reading()
        if reading.outcome in ("slowed", "blocked"):
            seen.update(reading.stopped_by)
    assert reading.clearance >= session.problem.clearance.safe - 1e-9
    assert session.tip[0] < 1.2
    assert any("wall" in name for name in seen)
    assert "wall" in read_out(session, "")


def test_a_held_control_vertex_is_drawn_while_the_tip_stays():
    session = Session(vq.load_problem("five_bay_free"))
    tip, start = session.tip, session.state.control_vertices[3].copy()
    goal = start + np.array([0.4, 0.2, 0.0])
    session.want_vertex(3, goal)
    for _ in range(40):
        session.advance(PERIOD)
    assert np.linalg.norm(session.state.control_vertices[3] - goal) < 0.1 * np.linalg.norm(start - goal)
    assert np.allclose(session.tip, tip, atol=1e-6)
    session.want_vertex(3, None)
    assert not session.advance(PERIOD)


@pytest.mark.parametrize("method", ["pseudoinverse", "curve-pseudoinverse"])
def test_the_older_methods_enter_the_cube_where_the_qp_keeps_out(session: Session, method: str):
    goal = np.array([1.6, 0.0, 3.0])
    session.want_tip(goal)
    for _ in range(120):
        session.advance(PERIOD)
    assert np.allclose(session.tip, goal, atol=1e-3)
    assert session.reading().clearance >= session.problem.clearance.safe - 1e-9
    session.change({"method.name": method})
    session.go_home()
    session.want_tip(goal)
    for _ in range(120):
        session.advance(PERIOD)
    assert session.reading().clearance < 0.0
    assert "#b91c1c" in read_out(session, "")


def test_the_hand_changes_between_all_methods_and_back(session: Session):
    shape, given = session.control_vertices.shape, session.problem.method
    for name in [*methods_for(session.problem), "qp"]:
        session.use_method(name)
        assert method_name(session.problem) == name
        session.want_tip(session.tip + np.array([0.01, 0.0, -0.005]))
        assert session.advance(PERIOD), name
        assert session.control_vertices.shape == shape
        assert np.linalg.norm(session.control_vertices[-1] - session.tip) < 0.1
        assert f">{name}<" in read_out(session, "")
        session.go_home()
    assert session.problem.method == given


@pytest.mark.parametrize(
    "own",
    [
        {"method.tracking_mode": "elastic"},
        {"method.solver": "piqp"},
        {"method.slow_approach": False},
        {"method.weights.curve_rate": 0.01, "method.weights.tangent": 0.02},
    ],
)
def test_the_hand_offers_the_methods_that_the_command_takes_whatever_the_problem_asks_of_its_own(own):
    session = Session(vq.load_problem("five_bay_two_cubes").replace(own))
    for name, problem in methods_for(session.problem).items():
        session.use_method(name)
        assert session.problem.method == problem.method, name
    session.use_method("qp")
    assert session.problem.method == vq.load_problem("five_bay_two_cubes").replace(own).method


def test_a_serial_arm_is_offered_what_can_move_it():
    served = list(methods_for(vq.load_problem("snake_past_a_cube")))
    assert served[:3] == ["qp", "qp-osqp", "qp-none"]
    assert {name.partition("-")[0] for name in served} == {"qp", "pseudoinverse", "curve"}
    assert {"qp-recursive", "qp-parallel"}.isdisjoint(served)


def test_a_changed_setting_keeps_the_state_and_a_wrong_one_changes_nothing(session: Session):
    session.want_tip(session.tip + np.array([0.1, 0.0, 0.0]))
    for _ in range(10):
        session.advance(PERIOD)
    nodes = session.state.nodes.copy()
    session.change({"clearance.safe": 0.05, "method.weights.tracking": 3.0})
    assert session.problem.clearance.safe == 0.05
    assert np.array_equal(session.state.nodes, nodes)
    with pytest.raises(vq.ProblemError):
        session.change({"clearance.safe": -1.0})
    assert session.problem.clearance.safe == 0.05
    session.go_home()
    assert not session.advance(PERIOD)
    assert np.array_equal(session.state.nodes, Session(session.problem).state.nodes)


def test_a_state_of_a_result_can_be_taken_up(session: Session, maneuver: vq.Maneuver):
    session.put_at(maneuver.time[12], maneuver.nodes[12], maneuver.control_vertices[12])
    assert np.allclose(session.tip, maneuver.tip_position[12], atol=1e-12)
    assert np.allclose(session.state.quantities, maneuver.member_lengths[12], atol=1e-12)
    session.want_tip(session.tip + np.array([0.0, 0.05, 0.0]))
    assert any(session.advance(PERIOD) for _ in range(20))


def test_the_read_out_is_plain_and_safe_html(session: Session):
    text = read_out(session, "<script>alert(1)</script>")
    assert "<script>" not in text
    assert "&lt;script&gt;" in text
    for words in ("clearance", "strokes", "active constraints", "at rest"):
        assert words in text
    assert text.count("background:rgb(") == 15


@pytest.fixture
def page_of() -> Iterator[Any]:
    """Give a function that serves the page of a problem or result and returns its address."""
    stop, threads = threading.Event(), []

    def serve(shown: vq.Problem | vq.Maneuver) -> str:
        addresses: Queue[str] = Queue()
        thread = threading.Thread(
            target=view, args=(shown,), kwargs={"port": 0, "ready": addresses.put, "stop": stop}
        )
        thread.start()
        threads.append(thread)
        return addresses.get(timeout=PATIENCE)

    yield serve
    stop.set()
    for thread in threads:
        thread.join(timeout=PATIENCE)
        assert not thread.is_alive()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    if not CHROMIUM.exists():
        pytest.skip(f"no browser: {CHROMIUM} is not there")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
        yield chromium
        chromium.close()


@pytest.fixture
def tab(browser: Any) -> Iterator[Any]:
    """Give a tab that notes every error and every request that leaves this machine."""
    context = browser.new_context(viewport={"width": 1000, "height": 640})
    context.set_default_timeout(1000.0 * PATIENCE)
    tab = context.new_page()
    tab.errors, tab.strangers = [], []
    tab.on("console", lambda message: tab.errors.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: tab.errors.append(str(error)))

    def note(request: Any) -> None:
        if not re.match(r"(file|blob|data):|(https?|ws)://127\.0\.0\.1[:/]", request.url):
            tab.strangers.append(request.url)

    context.on("request", note)
    yield tab
    context.close()


def picture_of(tab: Any) -> NDArray[np.int64]:
    """Return the scene as (H, W, 3) numbers, without the panel at its right."""
    with Image.open(io.BytesIO(tab.screenshot())) as picture:
        return np.asarray(picture.convert("RGB")).astype(np.int64)[:, :SCENE_WIDTH]


def pixels(tab: Any, wanted: Callable[[NDArray[np.int64]], NDArray[np.bool_]]) -> NDArray[np.int64]:
    """Return rows and columns (2, K) of pixels of a kind, once there are more than 20: a page fades in."""
    end = monotonic() + PATIENCE
    while monotonic() < end:
        found = np.array(np.nonzero(wanted(picture_of(tab))))
        if found.shape[1] > 20:
            return found
        tab.wait_for_timeout(100)
    raise AssertionError("the page does not show it")


def is_red(picture: NDArray[np.int64]) -> NDArray[np.bool_]:
    return (picture[..., 0] > 140) & (picture[..., 1:].max(axis=2) < 75)


def is_amber(picture: NDArray[np.int64]) -> NDArray[np.bool_]:
    return (picture[..., 0] > 180) & (picture[..., 0] - picture[..., 2] > 70) & (picture[..., 1] > 130)


def open_page(tab: Any, address: str) -> None:
    """Open a live page, wait until it is there, and close its notice about rendering without a GPU."""
    tab.goto(address)
    tab.get_by_text("at rest").wait_for()
    tab.locator(".mantine-Notification-closeButton").click()


def drag(tab: Any, way: tuple[float, float]) -> None:
    """Take the red ball at the tip by its middle and drag it by `way`, pixels."""
    y, x = np.median(pixels(tab, is_red), axis=1)
    tab.mouse.move(x, y)
    tab.mouse.down()
    for k in range(1, 11):
        tab.mouse.move(x + way[0] * k / 10, y + way[1] * k / 10)
        tab.wait_for_timeout(80)
    tab.mouse.up()


def wait_for_strokes(tab: Any, condition: str) -> None:
    """Wait until the number of different strokes on the page meets `condition`."""
    heights = "[...document.querySelectorAll(\"div[title^='B']\")].map(bar => bar.style.height)"
    tab.wait_for_function(f"() => new Set({heights}).size {condition}")


def test_the_page_loads_without_errors_and_a_drag_moves_the_arm(tab: Any, page_of: Any, problem: vq.Problem):
    open_page(tab, page_of(problem))
    wait_for_strokes(tab, "== 1")
    pixels(tab, is_red)
    assert tab.errors == []
    drag(tab, (50.0, 20.0))
    wait_for_strokes(tab, "> 1")
    assert tab.strangers == []


def test_a_blocked_drag_names_the_obstacle(tab: Any, page_of: Any):
    open_page(tab, page_of(vq.load_problem("five_bay_blocked_by_wall")))
    drag(tab, (280.0, 60.0))
    held = tab.locator("#stopped-by")
    held.filter(has_text="wall").wait_for()
    assert "wall" in held.inner_text()


def test_a_result_plays_back_and_goes_home(tab: Any, page_of: Any, maneuver: vq.Maneuver):
    open_page(tab, page_of(maneuver))
    # The button says Pause only while the arm moves, and a busy browser may never show that: what stays is waited for.
    tab.get_by_role("button", name="Play", exact=True).click()
    wait_for_strokes(tab, "> 1")
    tab.get_by_role("tab", name="Move", exact=True).click()
    tab.get_by_role("button", name="Home", exact=True).click()
    wait_for_strokes(tab, "== 1")
    assert tab.strangers == []


def test_the_exported_page_plays_from_disk_with_the_network_off(
    tab: Any, maneuver: vq.Maneuver, tmp_path: Path
):
    path = vq.export_maneuver(maneuver, tmp_path / "arm.html")
    tab.context.set_offline(True)
    tab.goto(path.as_uri())
    pixels(tab, is_amber)
    first = picture_of(tab)
    end = monotonic() + PATIENCE
    while (picture_of(tab) != first).any(axis=2).sum() <= 500:
        assert monotonic() < end, "the page does not move"
        tab.wait_for_timeout(100)
    assert tab.errors == []
    assert tab.strangers == []


def test_the_command_serves_this_machine_alone_and_ends_when_interrupted():
    import signal
    import socket

    command = [sys.executable, "-c", "from vgtm_qp.cli import main; raise SystemExit(main())"]
    with subprocess.Popen(
        [*command, "view", "five_bay_free", "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)", address)
        assert found, address
        port = int(found[1])
        with socket.create_connection(("127.0.0.1", port), timeout=5):
            pass
        with pytest.raises(OSError, match="refused"):
            socket.create_connection(("127.0.0.2", port), timeout=5)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=PATIENCE) == 0
