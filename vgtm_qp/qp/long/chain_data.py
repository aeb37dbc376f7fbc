"""The numbers of a step laid out period by period, as the eliminations along a chain read them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.qp.long.chain import Chain
from vgtm_qp.qp.numbers import StepNumbers

Array = NDArray[np.float64]


class ChainData:
    """The numbers of every period as rows of one array, and the curve's own terms.

    Attributes
    ----------
    data : (n, size)
        From the base to the tip, in the order of ``elimination.Inputs``.
    offset : (V, 3)
        Displacements of the control vertices where the free coordinates are zero, m.
    normal : (3,)
        The direction in which the second control vertex moves.
    """

    def __init__(self, chain: Chain, sizes: dict[str, int]) -> None:
        self.chain = chain
        layout, periods = chain.layout, chain.periods
        ends = np.cumsum(list(sizes.values())).tolist()
        self.data: Array = np.zeros((periods, ends[-1]))
        self._part = {
            name: self.data[:, end - size : end]
            for (name, size), end in zip(sizes.items(), ends, strict=True)
        }
        self._faces = chain.faces.reshape(-1)
        self._order = chain.face_order.reshape(-1, 1, 3, 1)
        self._weights, self._slopes = layout.curve_weights[self._faces], layout.curve_slopes[self._faces]
        self._slope_products = (self._slopes[:, :, None] * self._slopes[:, None, :]).reshape(
            len(self._faces), layout.vertices**2
        )
        self._actuator = np.zeros(layout.truss.member_count)
        self._soft = chain.members[:, chain.soft]
        self.offset, self.normal = np.zeros((layout.vertices, 3)), np.zeros(3)
        if len(self._faces):
            self._part["weights"][:] = self._weights[:, 1:].reshape(periods, -1)
            self._part["slopes"][:] = self._slopes[:, 1:].reshape(periods, -1)
        weights = layout.weights
        self._polygon = layout.vertex_hessian
        self._tracking = 0.0 if layout.hard_tracking else weights.tracking
        self._hessian = self._polygon + self._tracking * self._weights.T @ self._weights

    def fill(self, numbers: StepNumbers) -> None:
        """Overwrite everything with the values of `numbers`."""
        chain, part, periods = self.chain, self._part, self.chain.periods
        part["jacobian"][:] = (chain.gather @ numbers.gradient.reshape(-1)).reshape(periods, -1)
        part["rhs"][:] = numbers.length_rhs[chain.members]
        self._actuator[chain.layout.truss.actuators] = numbers.actuator_gradient
        part["actuator_gradient"][:] = self._actuator[self._soft]
        self.actuator_gradient = part["actuator_gradient"].reshape(-1)
        if not chain.layout.vertices:
            return
        self.offset[0] = numbers.base_displacement
        self.offset[1] = numbers.base_displacement + numbers.base_rhs @ numbers.base_axes
        self.offset[2:] = 0.0
        self.normal = np.cross(numbers.base_axes[0], numbers.base_axes[1])
        self._tangent_curve = numbers.tangent_curve[self._faces]
        self._position_rhs, self._tangent_rhs = (
            numbers.position_rhs[self._faces],
            numbers.tangent_rhs[self._faces],
        )
        self._vertex_gradient = numbers.vertex_gradient
        gap, tilt = self._misfit(self.offset)
        turns = numbers.tangent_face[self._faces].reshape(-1, 2, 3, 3)
        part["tangent_face"][:] = np.take_along_axis(turns, self._order, axis=2).reshape(periods, -1)
        part["tangent_curve"][:] = self._tangent_curve.reshape(periods, -1)
        part["gap"][:], part["tilt"][:] = gap.reshape(periods, -1), tilt.reshape(periods, -1)
        part["normal"][:] = self.normal

    def _misfit(self, vertices: Array) -> tuple[Array, Array]:
        """Return gap (K, 3) and tilt (K, 2) where the vertices are displaced so and the faces are not."""
        gap = self._position_rhs - self._weights @ vertices
        return gap, self._tangent_rhs + np.einsum("kac,kc->ka", self._tangent_curve, self._slopes @ vertices)

    def vertices(self, free: Array) -> Array:
        """Return (V, 3) the displacements of the control vertices for free coordinates (3V - 5,)."""
        vertices = self.offset.copy()
        if len(vertices):
            vertices[1] += free[0] * self.normal
            vertices[2:] += free[1:].reshape(-1, 3)
        return vertices

    def _reduced(self, gradient: Array) -> Array:
        """Return (3V - 5, ...) the gradient in the free coordinates of one in the vertices, (V, 3, ...)."""
        first = np.einsum("c...,c->...", gradient[1], self.normal)
        return np.concatenate([first[None], gradient[2:].reshape(-1, *gradient.shape[2:])])

    def polygon_terms(self) -> tuple[Array, Array]:
        """Return Hessian (3V - 5, 3V - 5) and gradient (3V - 5,) of the terms in the vertices alone."""
        count = len(self.offset)
        hessian = np.zeros((count, 3, count, 3))
        axis = np.arange(3)
        hessian[:, axis, :, axis] = self._polygon
        reduced = self._reduced(self._reduced(hessian).transpose(1, 2, 0))
        return reduced, self.polygon_gradient(self.offset)

    def polygon_gradient(self, vertices: Array) -> Array:
        """Return (3V - 5,) the gradient of those terms where the vertices are displaced so."""
        return self._reduced(self._polygon @ vertices + self._vertex_gradient)

    def curve_terms(self) -> tuple[Array, Array]:
        """Return Hessian and gradient of all terms in the curve's coordinates while the faces stay."""
        count = len(self.offset)
        turned = self._tangent_curve[..., None] * self._tangent_curve[:, :, None]
        hessian: Array = self.chain.layout.weights.tangent * (
            self._slope_products.T @ turned.sum(axis=1).reshape(-1, 9)
        )
        hessian = hessian.reshape(count, count, 3, 3).transpose(0, 2, 1, 3)
        axis = np.arange(3)
        hessian[:, axis, :, axis] += self._hessian
        reduced = self._reduced(self._reduced(hessian).transpose(1, 2, 0))
        return reduced, self.curve_gradient(self.offset, *self._misfit(self.offset))

    def curve_gradient(self, vertices: Array, gap: Array, tilt: Array) -> Array:
        """Return (3V - 5,) the objective's gradient in the curve's coordinates, given all gaps and angles."""
        gradient = self._polygon @ vertices + self._vertex_gradient - self._tracking * self._weights.T @ gap
        angles = np.einsum("kac,ka->kc", self._tangent_curve, tilt)
        return self._reduced(gradient + self.chain.layout.weights.tangent * self._slopes.T @ angles)

    def face_parts(self, nodes: Array, numbers: StepNumbers) -> Array:
        """Return (K, 5) what displacements of the nodes (N, 3) do to gaps and angles."""
        truss = self.chain.layout.truss
        faces = self.chain.layout.tracked[self._faces]
        moved = nodes[truss.faces[faces]]
        centres = np.einsum("kf,kfc->kc", truss.face_weights[faces], moved)
        angles = np.einsum("kaf,kf->ka", numbers.tangent_face[self._faces], moved.reshape(-1, 9))
        return np.hstack([centres, angles])

    def misfit(self, vertices: Array, faces: Array) -> tuple[Array, Array]:
        """Return gap (K, 3) and tilt (K, 2) for displaced vertices and the faces' own parts (K, 5)."""
        gap, tilt = self._misfit(vertices)
        return gap + faces[:, :3], tilt + faces[:, 3:]
