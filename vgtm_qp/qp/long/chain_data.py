"""The numbers of a step laid out period by period, as the eliminations along a chain read them."""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.arm import LengthRowsLike
from vgtm_qp.qp.long.chain import Chain
from vgtm_qp.qp.numbers import StepNumbers

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class ChainData:
    """The numbers of every period as rows of three arrays, and the curve's own terms.

    Attributes
    ----------
    head, tail, table : (n, ...)
        In the order of ``elimination.Inputs``; periods from the base to the tip, or the other way where `is_reversed`.
    part : dict
        Their parts by name.
    lean : (n, 9f)
        Products t t' of the rows t of ``tangent_curve``, summed over the two angles of a face.
    window, members, face_order : (n, w + m), (n, 3m), (n, f, 3) int
        Those of the chain, by row.
    at : (M,) int
        Places of the members in `members`.
    faces : (K,) int
        Positions in ``layout.tracked`` of the faces by row.
    weights, slopes : (K, V)
        Of the control vertices at those faces.
    offset : (V, 3)
        Displacements of the control vertices where the free coordinates are zero, m.
    normal : (3,)
        The direction in which the second control vertex moves.
    """

    def __init__(self, chain: Chain, sizes: dict[str, dict[str, int]], *, is_reversed: bool = False) -> None:
        self._chain, self.is_reversed = chain, is_reversed
        layout, order = chain.layout, slice(None, None, -1 if is_reversed else 1)
        self.part: dict[str, Array] = {}
        arrays = []
        for parts in sizes.values():
            ends = np.cumsum(list(parts.values())).tolist()
            arrays.append(np.zeros((chain.periods, ends[-1])))
            for (name, size), end in zip(parts.items(), ends, strict=True):
                self.part[name] = arrays[-1][:, end - size : end]
        self.head, self.tail, self.table = arrays
        self.lean: Array = np.zeros((chain.periods, 9 * chain.faces.shape[1]))
        self.window, self.members = chain.window[order], chain.members[order]
        self.at = np.argsort(self.members.reshape(-1))
        self.faces, self.face_order = chain.faces[order].reshape(-1), chain.face_order[order]
        self.weights, self.slopes = layout.curve_weights[self.faces], layout.curve_slopes[self.faces]
        self.part["weights"][:] = self.weights.reshape(self.part["weights"].shape)
        self.part["slopes"][:] = self.slopes.reshape(self.part["slopes"].shape)
        self._slope_products = (self.slopes[:, :, None] * self.slopes[:, None, :]).reshape(
            len(self.faces), layout.vertices**2
        )
        self._soft = self.members[:, chain.soft]
        self.offset, self.normal = np.zeros((layout.vertices, 3)), np.zeros(3)
        self.vertex_gradient = np.zeros((layout.vertices, 3))
        self._polygon = layout.vertex_hessian
        self._tracking = 0.0 if layout.hard_tracking else layout.weights.tracking
        along = self._polygon + self._tracking * self.weights.T @ self.weights
        self._hessian, self._polygon_hessian = np.kron(along, np.eye(3)), np.kron(self._polygon, np.eye(3))
        # What the free coordinates of the curve do to the vertices' coordinates: the second vertex slides on a line.
        self._free = np.eye(3 * layout.vertices)[:, 5:]
        self._free[:6] = 0.0

    def fill(self, numbers: StepNumbers) -> None:
        """Overwrite everything with the values of `numbers`."""
        chain, part = self._chain, self.part
        rows, scatter = cast(LengthRowsLike, numbers.motion), chain.bays.scatter
        jacobian = part["jacobian"]
        gradient = rows.gradient.reshape(-1)[scatter.flat]
        found = np.bincount(chain.gathered, gradient, jacobian.size).reshape(jacobian.shape)
        jacobian[:] = found[::-1] if self.is_reversed else found
        part["rhs"][:] = rows.rhs[self.members]
        actuator = np.zeros(chain.bays.member_count)
        actuator[chain.bays.actuators] = numbers.actuator_gradient
        part["actuator_gradient"][:] = actuator[self._soft]
        if not len(self.offset):
            return
        axes = numbers.base_axes
        self.offset[:2] = numbers.base_displacement
        self.offset[1] += numbers.base_rhs @ axes
        self.hold_base(self.offset, np.cross(*axes))
        self.vertex_gradient = numbers.vertex_gradient
        turns = numbers.tangent_face[self.faces].reshape(-1, 2, 3, 3)
        order = self.face_order.reshape(-1, 1, 3, 1)
        lean = numbers.tangent_curve[self.faces]
        gap = numbers.position_rhs[self.faces] - self.weights @ self.offset
        tilt = numbers.tangent_rhs[self.faces]
        tilt = tilt + np.einsum("kac,kc->ka", lean, self.slopes @ self.offset)
        filled = {
            "tangent_face": np.take_along_axis(turns, order, axis=2),
            "tangent_curve": lean,
            "gap": gap,
            "tilt": tilt,
        }
        for name, values in filled.items():
            part[name][:] = values.reshape(part[name].shape)
        self.lean[:] = np.einsum("kac,kad->kcd", lean, lean).reshape(self.lean.shape)

    def hold_base(self, offset: Array, normal: Array) -> None:
        """Set what the base makes of the curve: `offset` (V, 3) and `normal` (3,)."""
        self.offset[:], self.normal[:] = offset, normal
        self._free[3:6, 0] = normal
        self.part["normal"][:] = normal

    def member_rows(self, members: Index) -> tuple[Index, Array]:
        """Return nodes (R, w + m) and the gradient (R, w + m, 3) of the lengths of `members` (R,)."""
        period, row = np.divmod(self.at[members], self.members.shape[1])
        entry = self._chain.entry.reshape(self.members.shape[1], -1, 3)[row]
        values = self.part["jacobian"][period[:, None, None], entry]
        return self.window[period], np.where(entry >= 0, values, 0.0)

    def vertices(self, free: Array) -> Array:
        """Return (V, 3) the displacements of the control vertices for free coordinates (3V - 5,)."""
        return self.offset + (self._free @ free).reshape(-1, 3)

    def polygon_terms(self) -> tuple[Array, Array]:
        """Return Hessian (3V - 5, 3V - 5) and gradient (3V - 5,) of the terms in the vertices alone."""
        return self._free.T @ self._polygon_hessian @ self._free, self.polygon_gradient(self.offset)

    def polygon_gradient(self, vertices: Array) -> Array:
        """Return (3V - 5,) the gradient of those terms where the vertices are displaced so."""
        gradient = self._polygon @ vertices + self.vertex_gradient
        return np.asarray(gradient.reshape(-1) @ self._free)

    def curve_terms(self) -> tuple[Array, Array]:
        """Return Hessian and gradient of all terms in the curve's coordinates while the faces stay."""
        count = len(self.offset)
        leaning = self._slope_products.T @ self.lean.reshape(-1, 9)
        leaning = leaning.reshape(count, count, 3, 3).transpose(0, 2, 1, 3).reshape(3 * count, 3 * count)
        hessian = self._hessian + self._chain.layout.weights.tangent * leaning
        gap, tilt = self.part["gap"].reshape(-1, 3), self.part["tilt"].reshape(-1, 2)
        return self._free.T @ hessian @ self._free, self.curve_gradient(self.offset, gap, tilt)

    def curve_gradient(self, vertices: Array, gap: Array, tilt: Array) -> Array:
        """Return (3V - 5,) the objective's gradient in the curve's coordinates, given all gaps and angles."""
        lean = self.part["tangent_curve"].reshape(-1, 2, 3)
        angles = tilt[:, :1] * lean[:, 0] + tilt[:, 1:] * lean[:, 1]
        gradient = self._chain.layout.weights.tangent * self.slopes.T @ angles
        gradient -= self._tracking * self.weights.T @ gap
        return self.polygon_gradient(vertices) + gradient.reshape(-1) @ self._free

    def misfit(self, vertices: Array, faces: Array) -> tuple[Array, Array]:
        """Return gap (K, 3) and tilt (K, 2) for displaced vertices and the faces' own parts (K, 5)."""
        moved = vertices - self.offset
        lean = self.part["tangent_curve"].reshape(-1, 2, 3)
        gap = self.part["gap"].reshape(-1, 3) - self.weights @ moved
        tilt = self.part["tilt"].reshape(-1, 2) + np.einsum("kac,kc->ka", lean, self.slopes @ moved)
        return gap + faces[:, :3], tilt + faces[:, 3:]
