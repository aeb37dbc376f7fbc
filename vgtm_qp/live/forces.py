"""The forces on the page: what members or joints bear where something pulls at the tip."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vgtm_qp.arm.arm import Arm
from vgtm_qp.arrays import Array
from vgtm_qp.errors import SolverError
from vgtm_qp.live.stage import PageStage
from vgtm_qp.view.drawing import force_colours

_LOAD = (0.0, 0.0, -100.0)
"""The force at the tip until another is given, N."""


class ForceTools:
    """The force at the tip, and what it causes in words and colours.

    Attributes
    ----------
    said : str
        The greatest forces, in words; empty while none are shown.
    """

    def __init__(self, stage: PageStage) -> None:
        self._stage, self.said = stage, ""
        gui, inbox = stage.server.gui, stage.inbox
        self._load = gui.add_vector3("force at the tip [N]", _LOAD, step=10.0)
        self._is_shown = gui.add_checkbox(
            "Show forces", False, hint="with the arm's own weight, where its joints have masses"
        )
        self._text = gui.add_markdown("")
        for widget in (self._load, self._is_shown):
            inbox.on(widget.on_update, lambda _: self._stage.draw(), newest="force")
        stage.prepares.append(self.prepare)

    def prepare(self) -> None:
        """Colour the arm by its forces where it is, before it is drawn."""
        stage = self._stage
        if not self._is_shown.value:
            stage.scene.painted, said = None, ""
        else:
            are_lengths = stage.session.drawing.arm.unit == "m"
            try:
                forces = stage.session.forces(self._load.value)
                said = told(forces, stage.session.arm, are_lengths)
                stage.scene.painted = force_colours(forces) if are_lengths else None
            except SolverError as error:
                stage.scene.painted, said = None, str(error)
        if said != self.said:
            self.said = self._text.content = said


def told(forces: Array, arm: Arm, are_lengths: bool) -> str:
    """Return the greatest pull and push of members, or the greatest loads of joints, in words."""
    if not len(forces):
        return ""
    if not are_lengths:
        return "  \n".join(_of_joints(forces, arm))
    names, pull, push = arm.quantity_names, int(np.argmax(forces)), int(np.argmin(forces))
    parts = []
    if forces[pull] > 0.0:
        parts.append(f"greatest pull: {forces[pull]:.4g} N in {names[pull]} (blue)")
    if forces[push] < 0.0:
        parts.append(f"greatest push: {-forces[push]:.4g} N in {names[push]} (red)")
    return "  \n".join(parts)


def _of_joints(forces: Array, arm: Arm) -> Iterator[str]:
    """Yield the greatest load of a joint, what weighs on them, and the joints that bear more than they may."""
    borne, unit = np.abs(forces), "N m (N where it slides)"
    k = int(np.argmax(borne))
    yield f"greatest load of a joint: {borne[k]:.4g} {unit} at {arm.quantity_names[k]}"
    if arm.mass:
        yield f"with the arm's own weight, {arm.mass:.4g} kg"
    if arm.effort is None:
        return
    for k in np.flatnonzero(arm.actuated & (borne > arm.effort)).tolist():
        yield f"**{arm.quantity_names[k]} bears {borne[k]:.4g}, more than its effort limit {arm.effort[k]:g}**"
