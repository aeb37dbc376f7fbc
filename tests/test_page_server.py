"""Whom the live page answers, where it is served, and that no widget ends it."""

from __future__ import annotations

import base64
import os
import socket
from collections.abc import Iterator
from threading import Event
from typing import Any

import pytest

import vgtm_qp as vq
from vgtm_qp.cli import main
from vgtm_qp.live.page import Page, view
from vgtm_qp.live.session import Session
from vgtm_qp.methods import PRESETS
from vgtm_qp.view.server import refusal, viser_server

pytest.importorskip("viser")


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    with viser_server() as server:
        yield server.get_port()


def status(port: int, host: str, origin: str | None, *, upgrade: bool = True) -> int:
    """Return the status with which the server at `port` answers a request."""
    lines = ["GET / HTTP/1.1", f"Host: {host}"]
    if origin is not None:
        lines.append(f"Origin: {origin}")
    if upgrade:
        key = base64.b64encode(os.urandom(16)).decode()
        lines += ["Upgrade: websocket", "Connection: Upgrade", f"Sec-WebSocket-Key: {key}"]
        lines += ["Sec-WebSocket-Version: 13", f"Sec-WebSocket-Protocol: viser-v{_version()}"]
    else:
        lines.append("Connection: close")
    with socket.create_connection(("127.0.0.1", port), timeout=60.0) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        with connection.makefile("rb") as answer:
            return int(answer.readline().split()[1])


def _version() -> str:
    import viser

    return str(viser.__version__)


@pytest.mark.smoke
@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "LocalHost", "127.0.0.2", "[::1]"])
def test_the_page_opens_a_web_socket_to_its_own_server(port: int, name: str):
    assert status(port, f"{name}:{port}", None, upgrade=False) == 200
    assert status(port, f"{name}:{port}", f"http://{name}:{port}") == 101


def test_a_forwarded_port_is_still_the_page_of_its_own(port: int):
    assert status(port, "localhost:9", "http://localhost:9") == 101


@pytest.mark.parametrize(
    "origin",
    [
        "https://evil.example",
        "http://127.0.0.1:1",
        "http://localhost:{port}",
        "https://127.0.0.1:{port}",
        "null",
        "",
        None,
    ],
)
def test_a_web_socket_of_another_origin_is_refused(port: int, origin: str | None):
    given = None if origin is None else origin.format(port=port)
    assert status(port, f"127.0.0.1:{port}", given) == 403


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "localhost.evil.example", "192.168.0.7", "[::2]", ""]
)
@pytest.mark.parametrize("upgrade", [True, False])
def test_a_name_that_is_made_to_mean_this_machine_is_refused(port: int, host: str, upgrade: bool):
    named = f"{host}:{port}"
    assert status(port, named, f"http://{named}" if upgrade else None, upgrade=upgrade) == 403


def test_a_server_elsewhere_answers_to_its_own_address_too():
    def answered(host: str, served: str) -> bool:
        return not refusal([host], [f"http://{host}"], upgrades=True, served=served)

    assert answered("192.168.0.7:8080", "192.168.0.7")
    assert answered("robot.lan:8080", "robot.lan")
    assert not answered("192.168.0.8:8080", "192.168.0.7")
    assert not answered("evil.example:8080", "192.168.0.7")
    assert answered("192.168.0.7:8080", "0.0.0.0")
    # An address cannot be made to mean another machine, a name can.
    assert not answered("evil.example:8080", "0.0.0.0")
    assert refusal(["127.0.0.1", "evil.example"], [], upgrades=False)


def test_a_page_for_others_says_so(caplog):
    with pytest.raises(vq.VgtmError):
        view(vq.load_problem("five_bay_free"), host="0.0.0.0", port=-1)
    assert "whoever reaches this machine" in caplog.text


@pytest.mark.smoke
@pytest.mark.parametrize("wanted", ["99999999", "-1", "65536"])
def test_a_port_that_cannot_be_is_refused_at_once(wanted: str, capsys: pytest.CaptureFixture[str]):
    assert main(["view", "five_bay_free", f"--port={wanted}"]) == 2
    assert f"port {wanted}: expected one of 0 to 65535" in capsys.readouterr().err


def test_a_port_that_is_taken_gives_the_next_and_the_last_is_refused():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        wanted = taken.getsockname()[1]
        with viser_server(wanted) as server:
            assert server.get_port() > wanted
    with (
        socket.create_server(("127.0.0.1", 65535)),
        pytest.raises(vq.VgtmError, match="65535"),
        viser_server(65535),
    ):
        pass
    with (
        pytest.raises(vq.VgtmError, match=r"no-such-host.invalid"),
        viser_server(host="no-such-host.invalid"),
    ):
        pass


def act(page: Any, *actions: Any) -> None:
    """Let the loop of a page run actions as those of its widgets."""
    for action in actions:
        page.post(action)
    page.read_inbox()


def test_instruments_that_fail_do_not_end_the_page(monkeypatch, caplog):
    def broken(*_: object) -> str:
        stop.set()
        raise ZeroDivisionError("by design")

    stop = Event()
    with viser_server() as server:
        page = Page(server, Session(vq.load_problem("five_bay_free")), None)
        monkeypatch.setattr("vgtm_qp.live.page.read_out", broken)
        page.run(stop)
    assert "by design" in page.message
    assert "by design" in caplog.text


def test_whatever_a_widget_raises_is_shown_and_the_page_goes_on(caplog: pytest.LogCaptureFixture):
    with viser_server() as server:
        page = Page(server, Session(vq.load_problem("five_bay_free")), None)
        act(page, lambda: [][1], page.draw)
        assert "IndexError" in page.message
        assert "IndexError" in caplog.text
        assert "Traceback" in caplog.text
        page.set("clearance.safe", object())
        act(page)
        assert page.message


@pytest.mark.parametrize("method", PRESETS)
def test_a_maneuver_of_another_method_is_solved_and_played(method: str):
    problem = vq.load_problem("five_bay_free").replace({"maneuver.steps": 4})
    with viser_server() as server:
        page = Page(server, Session(problem), None)
        act(page, lambda: page.session.use_method(method), page.solve)
        for _ in range(3):
            act(page, lambda: page.play(0.5))
        act(page, lambda: page.session.use_method("qp"), lambda: page.play(0.5), page.draw)
        assert "internal error" not in page.message, page.message
        assert page.moment > 1.0
