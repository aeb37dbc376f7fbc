"""How the arm looks on the page: the links as its URDF file draws them, or the bodies that are kept clear."""

from __future__ import annotations

from vgtm_qp.live.stage import PageStage

_LOOKS = {"links": (True, False), "bodies": (False, True), "links and bodies": (True, True)}
"""By the name of a choice: whether links are shown, and bodies."""


class Looks:
    """The choice between links and bodies, where a URDF file draws links."""

    def __init__(self, stage: PageStage) -> None:
        self._stage = stage
        hint = "the links as the URDF file draws them, or the bodies that the solver keeps clear"
        self._choice = stage.server.gui.add_dropdown("show", tuple(_LOOKS), hint=hint)
        stage.inbox.on(self._choice.on_update, lambda _: self.rebuild(), newest="looks")
        self.rebuild()

    def rebuild(self) -> None:
        """Show what is chosen; there is no choice without links."""
        links, bodies = _LOOKS[self._choice.value]
        self._choice.visible = self._stage.scene.links is not None
        self._stage.scene.show(links=links, bodies=bodies)
