"""The viser server behind the live page and the offline page, and the choice of requests that it answers."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from functools import partial
from http import HTTPStatus
from io import StringIO
from threading import Lock
from typing import Any
from unittest.mock import patch

from vgtm_qp.errors import GoalError, MissingExtraError
from vgtm_qp.view.scene import import_viser

LOOPBACK = "127.0.0.1"
MOST_PORTS = 1000
"""Number of ports that are tried from the wanted one on."""

_starting = Lock()


@contextmanager
def viser_server(port: int = 0, host: str = LOOPBACK) -> Iterator[Any]:
    """Run a viser server at `host`; its own messages do not reach stdout.

    It answers only requests to a loopback name or to `host`, and only web sockets of its own pages. It uses
    the first free port from `port` on, any port for 0.

    Raises
    ------
    GoalError
        `port` is not from 0 to 65535, no port is free, or `host` is not an address of this machine.
    MissingExtraError
        viser is not installed, or is a version whose requests cannot be refused.
    """
    viser = import_viser()
    from websockets.asyncio import server as websockets

    given, listening, guards = websockets.serve, _listen(host, port), []

    def serve(handler: Any, _host: str, _port: int, *, process_request: Any, **options: Any) -> Any:
        guards.append(True)
        guarded = partial(_answer, host, process_request)
        return given(handler, sock=listening, process_request=guarded, **options)

    # viser has no option to refuse requests, and waits for ever if no port is free.
    with _starting, redirect_stdout(StringIO()), patch.object(websockets, "serve", serve):
        server = viser.ViserServer(host=host, port=listening.getsockname()[1], verbose=False)
    try:
        if not guards:
            raise MissingExtraError("view", "a viser whose web sockets can be guarded")
        yield server
    finally:
        with redirect_stdout(StringIO()):
            server.stop()
        listening.close()


def _listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens at `port` of `host` or the next free port; at any for 0."""
    if not 0 <= port <= 65535:
        raise GoalError(f"port {port}: expected one of 0 to 65535, 0 for any that is free")
    reason: OSError | None = None
    for candidate in range(port, min(port + (MOST_PORTS if port else 1), 65536)):
        try:
            family = socket.getaddrinfo(host, candidate, type=socket.SOCK_STREAM)[0][0]
            return socket.create_server((host, candidate), family=family)
        except OSError as error:
            reason = error
            if isinstance(error, socket.gaierror):
                break
    raise GoalError(
        f'the page cannot be served at "{host}", port {port} or one of the next {MOST_PORTS}: {reason}; '
        f"expected an address of this machine with a free port"
    )


def _answer(host: str, process_request: Any, connection: Any, request: Any) -> Any:
    """Refuse a request that another site may have sent; let viser answer all others."""
    headers = request.headers
    upgrades = "websocket" in ",".join(headers.get_all("Upgrade")).lower()
    why = refusal(headers.get_all("Host"), headers.get_all("Origin"), upgrades=upgrades, served=host)
    if why:
        return connection.respond(HTTPStatus.FORBIDDEN, f"{why}\n")
    return process_request(connection, request)


def refusal(hosts: list[str], origins: list[str], *, upgrades: bool, served: str = LOOPBACK) -> str:
    """Return why a request is not answered; empty if it is.

    Parameters
    ----------
    hosts, origins
        Its ``Host`` and ``Origin`` headers.
    upgrades
        Whether it asks for a web socket; then a browser names the page's origin.
    served
        Address that the server listens at.
    """
    name = _name(hosts[0]) if len(hosts) == 1 else ""
    if not _is_answered(name, served):
        # While its page is open, another site can make its own name resolve to this address.
        return f"this page answers to {LOOPBACK}, localhost and the address that it was started with alone"
    if (upgrades or origins) and [origin.lower() for origin in origins] != [f"http://{hosts[0].lower()}"]:
        return "this page answers to itself alone, not to pages of another origin"
    return ""


def _name(host: str) -> str:
    """Return a ``Host`` header without its port and the brackets of IPv6, in lower case."""
    name, colon, port = host.lower().rpartition(":")
    name = name if colon and port.isdigit() else host.lower()
    return name[1:-1] if name.startswith("[") and name.endswith("]") else name


def _is_answered(name: str, served: str) -> bool:
    if name and name in ("localhost", served.lower()):
        return True
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        return False
    # An address cannot be made to mean another machine: if all are served, any of them will do.
    return address.is_loopback or is_unspecified(served)


def is_unspecified(host: str) -> bool:
    """Return whether a server at `host` can be reached by every address of this machine."""
    return host in ("", "0.0.0.0", "::")


def is_loopback(host: str) -> bool:
    """Return whether a server at `host` can be reached from this machine alone."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
