"""The links of a serial arm as its URDF file draws them, in the place of the bodies that are kept clear."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import VgtmError
from vgtm_qp.problem.urdf import UrdfVisual, read_visuals
from vgtm_qp.rotation import quaternion
from vgtm_qp.verify.arm import AnyRecordedArm

_SAME = 1e-9
"""Difference of joints, m or 1, up to which the URDF file is still that of the arm."""


def link_surfaces(problem: Mapping[str, Any], arm: AnyRecordedArm, directory: Path) -> tuple[UrdfVisual, ...]:
    """Return what the URDF file of a problem draws of the arm's links.

    Nothing without such a file, and nothing where its joints are no longer those of the arm.
    """
    table = problem.get("arm") or {}
    if not table.get("urdf"):
        return ()
    file = directory / Path(table["urdf"]).expanduser()
    packages = [directory / Path(place).expanduser() for place in table.get("package_path") or ()]
    links = {key: table.get(key) for key in ("base_link", "tip_link")}
    try:
        if not file.is_file():
            return ()
        joints, surfaces = read_visuals(file, **links, package_path=packages)
    except (VgtmError, OSError):
        return ()
    if tuple(joint.name for joint in joints) != arm.quantity_names:
        return ()
    geometry = ("axis", "position", "rotation")
    found = {key: np.array([getattr(joint, key) for joint in joints]) for key in geometry}
    differs = any(np.abs(found[key] - getattr(arm, key)).max() > _SAME for key in geometry)
    return () if differs else surfaces


class LinkScene:
    """Surfaces of links in a viser scene, each in the frame of the joint that moves it."""

    def __init__(self, scene: Any, arm: AnyRecordedArm, surfaces: Sequence[UrdfVisual]) -> None:
        self._arm = arm
        self._frames = {
            k: scene.add_frame(f"/links/{k}", show_axes=False) for k in {s.joint for s in surfaces}
        }
        for number, surface in enumerate(surfaces):
            scene.add_mesh_simple(
                f"/links/{surface.joint}/{number}",
                surface.vertices.astype(np.float32),
                surface.faces.astype(np.uint32),
                color=tuple(round(255 * channel) for channel in surface.colour),
                side="double",
            )

    def move(self, q: Array, resolution: float = 0.0) -> None:
        """Put the links where they are at a configuration (J + 6,); coordinates are rounded to a `resolution`."""
        frames = self._arm.frames(q[None])
        for k, frame in self._frames.items():
            origin, attitude = frames[k]
            for key, value in (("position", origin[0]), ("wxyz", quaternion(attitude[0]))):
                rounded = np.round(value / resolution) * resolution if resolution else value
                setattr(frame, key, rounded.astype(np.float32))

    def show(self, visible: bool) -> None:
        """Show or hide them."""
        for frame in self._frames.values():
            frame.visible = visible
