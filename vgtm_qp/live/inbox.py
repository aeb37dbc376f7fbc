"""What the widgets of the page ask for, and the loop does: no fault in it ends the page."""

from __future__ import annotations

import logging
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

from vgtm_qp.errors import VgtmError

_LOG = logging.getLogger(__name__)


class Inbox:
    """Actions of widgets, which run in threads of their own; the loop of the page does them one after another.

    Attributes
    ----------
    message : str
        The notice on the page: the last error, or what the page is doing; empty if there is none.
    after_fault : callable
        Called after an error that is no VgtmError, and so a mistake of this package.
    """

    def __init__(self) -> None:
        self.message = ""
        self.after_fault: Callable[[], None] = lambda: None
        self._actions: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._newest: dict[str, Callable[[], None]] = {}

    def post(self, action: Callable[[], None]) -> None:
        """Put an action into the inbox."""
        self._actions.put(action)

    def post_newest(self, key: str, action: Callable[[], None]) -> None:
        """Put an action into the inbox in the place of the one with the same key: of a drag, the last place counts."""
        self._newest[key] = action

    def on(self, register: Any, act: Callable[[Any], Any], *, newest: str = "") -> None:
        """Let `act` run in the loop whenever a hand causes the event; with a key, only the `newest` call counts.

        A value that the page itself sets causes no action.
        """

        async def callback(event: Any) -> None:
            if getattr(event, "client_id", 0) is None:
                return
            if newest:
                self.post_newest(newest, lambda: self._try(lambda: act(event)))
            else:
                self.post(lambda: self._try(lambda: act(event)))

        register(callback)

    def read(self) -> bool:
        """Do what was posted since the last call; return whether there was anything."""
        found = not self._actions.empty() or bool(self._newest)
        while not self._actions.empty():
            self.survive(self._actions.get())
        newest, self._newest = self._newest, {}
        for action in newest.values():
            self.survive(action)
        return found

    def _try(self, action: Callable[[], None]) -> None:
        """Run the action of a hand, which takes the last notice away."""
        self.message = ""
        action()

    def survive(self, action: Callable[[], Any]) -> None:
        """Run an action; any error becomes the notice, with a line in the log, and the page goes on."""
        try:
            action()
        except VgtmError as error:
            if str(error) != self.message:
                _LOG.warning("the page was asked for what cannot be: %s", error)
            self.message = str(error)
        except Exception as error:
            said = f"internal error, {type(error).__name__}: {error}; this is a bug in vgtm, please report it"
            if said != self.message:
                # The traceback is told once, not thirty times a second.
                _LOG.exception(said)
            self.message = said
            self.after_fault()
