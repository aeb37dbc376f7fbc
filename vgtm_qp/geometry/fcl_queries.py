"""Distances by python-fcl, each held against a bound that can be proven; an answer that fails it is not used.

FCL's distance from a capsule to a box is always too large, and for members parallel to edges on round
coordinates too large by up to a metre (FCL issue 508). So the capsule has radius zero, the caller subtracts
the radius, and an answer counts only if the plane through its own witness points separates segment and piece
by as much. FCL's signed distance is never asked for: it can end the process.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.geometry.batch import Batch
from vgtm_qp.geometry.exact import plane_function
from vgtm_qp.geometry.groups import Contacts
from vgtm_qp.geometry.shapes import Pieces

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_CERTIFIED = 1e-9


class FclQueries:
    """FCL objects of all pieces and one capsule, built once and moved in place.

    Attributes
    ----------
    asked, replaced : int
        Queries so far, and those whose answer the guard refused.
    """

    SHAPES: ClassVar[tuple[str, ...]] = ("box", "sphere", "cylinder")

    def __init__(self, pieces: Pieces) -> None:
        self.asked = self.replaced = 0
        self._pieces = pieces
        self._objects: dict[int, Any] = {}
        self._planes: dict[str, Batch] = {}
        self._member: Any = None

    def _start(self) -> None:
        import fcl

        self._fcl = fcl
        self._capsule = fcl.Capsule(0.0, 1.0)
        self._member = fcl.CollisionObject(self._capsule, fcl.Transform())
        self._request = fcl.DistanceRequest(enable_nearest_points=True, enable_signed_distance=False)

    def _object(self, piece: int) -> Any:
        if piece not in self._objects:
            fcl, shape, row = self._fcl, self._pieces.shape[piece], self._pieces.parameters[piece]
            if shape == "sphere":
                geometry, turn = fcl.Sphere(row[3]), np.eye(3)
            elif shape == "box":
                geometry, turn = fcl.Box(*(2.0 * row[12:15])), row[3:12].reshape(3, 3)
            else:
                geometry, turn = fcl.Cylinder(row[12], 2.0 * row[13]), row[3:12].reshape(3, 3)
            self._objects[piece] = fcl.CollisionObject(geometry, fcl.Transform(turn, row[:3]))
        return self._objects[piece]

    def improve(
        self,
        shape: str,
        pieces: Index,
        radius: Array,
        segments: Array,
        parameters: Array,
        contacts: Contacts,
        rows: Index,
    ) -> None:
        """Ask FCL for `rows` and write the answers that hold into `contacts`.

        Parameters
        ----------
        pieces, radius, segments, parameters
            (K,) piece indices, (K,) radii, (K, 6) ends, (K, 15) parameters at this time.
        contacts
            Exact, from surface to surface; they stay where FCL's answer is refused.
        """
        if not len(rows):
            return
        if self._member is None:
            self._start()
        ends = segments[rows]
        answers = self._ask(pieces[rows], ends, parameters[rows])
        gap = answers[:, 1:4] - answers[:, 4:7]
        length = np.sqrt(np.einsum("kc,kc->k", gap, gap))
        with np.errstate(divide="ignore", invalid="ignore"):
            normal = gap / length[:, None]
        if shape not in self._planes:
            self._planes[shape] = Batch(plane_function(shape))
        proven = self._planes[shape](ends, parameters[rows], normal)[:, 0]
        # Comparisons with NaN are false: a penetration, where FCL gives no normal, is refused too.
        holds = (answers[:, 0] > 0.0) & (np.abs(answers[:, 0] - proven) <= _CERTIFIED)
        self.asked += len(rows)
        self.replaced += int(len(rows) - np.count_nonzero(holds))
        contacts.distance[rows[holds]] = proven[holds] - radius[rows[holds]]
        # Where the nearest point is not unique, FCL may give one between the two ends of the contact.
        holds &= ~contacts.two()[rows]
        good = rows[holds]
        axis = ends[holds, 3:] - ends[holds, :3]
        offset = answers[holds, 1:4] - ends[holds, :3]
        square = np.maximum(np.einsum("kc,kc->k", axis, axis), 1e-300)
        contacts.t[good] = np.clip(np.einsum("kc,kc->k", axis, offset) / square, 0.0, 1.0)
        contacts.normal[good] = normal[holds]
        contacts.point[good] = answers[holds, 4:7]

    def _ask(self, pieces: Index, ends: Array, parameters: Array) -> Array:
        """Return FCL's distance and witness points on member and piece, (K, 7)."""
        answers = np.empty((len(ends), 7))
        middle = 0.5 * (ends[:, :3] + ends[:, 3:])
        axis = ends[:, 3:] - ends[:, :3]
        length = np.sqrt(np.einsum("kc,kc->k", axis, axis))
        turns = _quaternions(axis, length).tolist()
        moving = self._pieces.moving
        member, capsule, request = self._member, self._capsule, self._request
        distance, result_of = self._fcl.distance, self._fcl.DistanceResult
        for k, (piece, size) in enumerate(zip(pieces.tolist(), length.tolist(), strict=True)):
            obstacle = self._object(piece)
            if moving:
                obstacle.setTranslation(parameters[k, :3])
            capsule.lz = size
            member.setQuatRotation(turns[k])
            member.setTranslation(middle[k])
            result = result_of()
            answers[k, 0] = distance(member, obstacle, request, result)
            answers[k, 1:4], answers[k, 4:7] = result.nearest_points
        return answers


def _quaternions(axis: Array, length: Array) -> Array:
    """Return quaternions w, x, y, z (K, 4) that turn the z axis onto `axis`."""
    w = length + axis[:, 2]
    quaternion = np.stack([w, -axis[:, 1], axis[:, 0], np.zeros(len(axis))], axis=1)
    opposite = w <= 1e-9 * length
    quaternion[opposite] = (0.0, 1.0, 0.0, 0.0)
    return np.asarray(quaternion / np.linalg.norm(quaternion, axis=1)[:, None])
