"""The numbers of a step laid out period by period, as the eliminations along a chain read them."""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.arm import LengthRowsLike
from vgtm_qp.qp.long.chain import Chain
from vgtm_qp.qp.numbers import StepNumbers

Array = NDArray[np.float64]


class ChainData:
    """The numbers of every period as rows of three arrays, and the curve's own terms.

    Attributes
    ----------
    head, tail, table : (n, ...)
        In the order of ``elimination.Inputs``; periods from the base to the tip, or the other way where `reverse`.
    lean : (n, 9f)
        Products t t' of the rows t of ``tangent_curve``, summed over the two angles of a face.
    order : slice
        From periods along the chain to rows.
    faces : (K,) int
        Positions in ``layout.tracked`` of the faces by row.
    offset : (V, 3)
        Displacements of the control vertices where the free coordinates are zero, m.
    normal : (3,)
        The direction in which the second control vertex moves.
    """

    def __init__(self, chain: Chain, sizes: dict[str, dict[str, int]], *, reverse: bool = False) -> None:
        self.chain = chain
        layout, periods = chain.layout, chain.periods
        self.order, self.is_reversed = slice(None, None, -1 if reverse else 1), reverse
        self._part: dict[str, Array] = {}
        arrays = []
        for parts in sizes.values():
            ends = np.cumsum(list(parts.values())).tolist()
            arrays.append(np.zeros((periods, ends[-1])))
            for (name, size), end in zip(parts.items(), ends, strict=True):
                self._part[name] = arrays[-1][:, end - size : end]
        self.head, self.tail, self.table = arrays
        self.faces = chain.faces[self.order].reshape(-1)
        self.lean: Array = np.zeros((periods, 9 * chain.faces.shape[1]))
        self._order = chain.face_order[self.order].reshape(-1, 1, 3, 1)
        self._weights, self._slopes = layout.curve_weights[self.faces], layout.curve_slopes[self.faces]
        self._slope_products = (self._slopes[:, :, None] * self._slopes[:, None, :]).reshape(
            len(self.faces), layout.vertices**2
        )
        self._members = chain.members[self.order]
        self._soft = self._members[:, chain.soft]
        self._actuator = np.zeros(chain.bays.member_count)
        self.offset, self.normal = np.zeros((layout.vertices, 3)), np.zeros(3)
        self._vertex_gradient = np.zeros((layout.vertices, 3))
        if len(self.faces):
            self._part["weights"][:] = self._weights[:, 1:].reshape(periods, -1)
            self._part["slopes"][:] = self._slopes[:, 1:].reshape(periods, -1)
        weights = layout.weights
        self._polygon = layout.vertex_hessian
        self._tracking = 0.0 if layout.hard_tracking else weights.tracking
        along = self._polygon + self._tracking * self._weights.T @ self._weights
        self._hessian, self._polygon_hessian = np.kron(along, np.eye(3)), np.kron(self._polygon, np.eye(3))
        # What the free coordinates of the curve do to the vertices' coordinates: the second vertex slides on a line.
        self._free = np.eye(3 * layout.vertices)[:, 5:] if layout.vertices else np.zeros((0, 0))
        self._free[:6] = 0.0

    def fill(self, numbers: StepNumbers) -> None:
        """Overwrite everything with the values of `numbers`."""
        chain, part, periods = self.chain, self._part, self.chain.periods
        rows = cast(LengthRowsLike, numbers.motion)
        jacobian = (chain.gather @ rows.gradient.reshape(-1)).reshape(periods, -1)
        part["jacobian"][:] = jacobian[self.order]
        part["rhs"][:] = rows.rhs[self._members]
        self._actuator[chain.bays.actuators] = numbers.actuator_gradient
        part["actuator_gradient"][:] = self._actuator[self._soft]
        if not chain.layout.vertices:
            return
        self.hold_base(numbers.base_displacement, numbers.base_axes, numbers.base_rhs)
        self._vertex_gradient = numbers.vertex_gradient
        turns = numbers.tangent_face[self.faces].reshape(-1, 2, 3, 3)
        part["tangent_face"][:] = np.take_along_axis(turns, self._order, axis=2).reshape(periods, -1)
        lean = numbers.tangent_curve[self.faces]
        part["tangent_curve"][:] = lean.reshape(periods, -1)
        gap = numbers.position_rhs[self.faces] - self._weights @ self.offset
        tilt = numbers.tangent_rhs[self.faces]
        tilt = tilt + np.einsum("kac,kc->ka", lean, self._slopes @ self.offset)
        part["gap"][:], part["tilt"][:] = gap.reshape(periods, -1), tilt.reshape(periods, -1)
        self.lean[:] = np.einsum("kac,kad->kcd", lean, lean).reshape(periods, -1)

    def hold_base(self, displacement: Array, axes: Array, turn: Array) -> None:
        """Set what the base makes of the curve: see ``base_displacement``, ``base_axes`` and ``base_rhs`` of a QP."""
        self.offset[0] = displacement
        self.offset[1] = displacement + turn @ axes
        self.offset[2:] = 0.0
        first, second = axes.tolist()
        for c in range(3):
            a, b = (c + 1) % 3, (c + 2) % 3
            self.normal[c] = first[a] * second[b] - first[b] * second[a]
        self._free[3:6, 0] = self.normal
        if len(self.faces):
            self._part["normal"][:] = self.normal

    def pull(self, vertex_gradient: Array) -> None:
        """Set the gradient (V, 3) of the objectives in the control vertices."""
        self._vertex_gradient = vertex_gradient

    @property
    def actuator_gradient(self) -> Array:
        """(n, soft) the objective's gradient in the actuated lengths."""
        return self._part["actuator_gradient"]

    def _misfit(self, vertices: Array) -> tuple[Array, Array]:
        """Return gap (K, 3) and tilt (K, 2) where the vertices are displaced so and the faces are not."""
        moved = vertices - self.offset
        lean = self._part["tangent_curve"].reshape(-1, 2, 3)
        gap = self._part["gap"].reshape(-1, 3) - self._weights @ moved
        tilt = self._part["tilt"].reshape(-1, 2)
        return gap, tilt + np.einsum("kac,kc->ka", lean, self._slopes @ moved)

    def vertices(self, free: Array) -> Array:
        """Return (V, 3) the displacements of the control vertices for free coordinates (3V - 5,)."""
        vertices = self.offset.copy()
        if len(vertices):
            vertices[1] += free[0] * self.normal
            vertices[2:] += free[1:].reshape(-1, 3)
        return vertices

    def _reduced(self, gradient: Array) -> Array:
        """Return (3V - 5,) the gradient in the free coordinates of one in the vertices (V, 3)."""
        return np.asarray(gradient.reshape(-1) @ self._free)

    def polygon_terms(self) -> tuple[Array, Array]:
        """Return Hessian (3V - 5, 3V - 5) and gradient (3V - 5,) of the terms in the vertices alone."""
        return self._free.T @ self._polygon_hessian @ self._free, self.polygon_gradient(self.offset)

    def polygon_gradient(self, vertices: Array) -> Array:
        """Return (3V - 5,) the gradient of those terms where the vertices are displaced so."""
        return self._reduced(self._polygon @ vertices + self._vertex_gradient)

    def curve_terms(self) -> tuple[Array, Array]:
        """Return Hessian and gradient of all terms in the curve's coordinates while the faces stay."""
        count = len(self.offset)
        weight = self.chain.layout.weights.tangent
        leaning = weight * (self._slope_products.T @ self.lean.reshape(-1, 9))
        leaning = leaning.reshape(count, count, 3, 3).transpose(0, 2, 1, 3).reshape(3 * count, 3 * count)
        hessian = self._free.T @ (self._hessian + leaning) @ self._free
        gap, tilt = self._part["gap"].reshape(-1, 3), self._part["tilt"].reshape(-1, 2)
        return hessian, self.curve_gradient(self.offset, gap, tilt)

    def curve_gradient(self, vertices: Array, gap: Array, tilt: Array) -> Array:
        """Return (3V - 5,) the objective's gradient in the curve's coordinates, given all gaps and angles."""
        gradient = self._polygon @ vertices + self._vertex_gradient - self._tracking * self._weights.T @ gap
        lean = self._part["tangent_curve"].reshape(-1, 2, 3)
        angles = tilt[:, :1] * lean[:, 0] + tilt[:, 1:] * lean[:, 1]
        return self._reduced(gradient + self.chain.layout.weights.tangent * self._slopes.T @ angles)

    def misfit(self, vertices: Array, faces: Array) -> tuple[Array, Array]:
        """Return gap (K, 3) and tilt (K, 2) for displaced vertices and the faces' own parts (K, 5)."""
        gap, tilt = self._misfit(vertices)
        return gap + faces[:, :3], tilt + faces[:, 3:]
