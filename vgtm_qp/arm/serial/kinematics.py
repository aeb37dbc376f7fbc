"""A serial arm at numbers: joints, stations and tip of one configuration, and how its nodes move with the joints."""

from __future__ import annotations

import casadi as ca
import numpy as np

from vgtm_qp.arm.frames import frames_at
from vgtm_qp.arm.serial.chain import Array, SerialChain
from vgtm_qp.compiled import Kernel


class ChainRows:
    """d_rho - K d_a = r, for an arm whose actuators are its configuration; see ``arm.MotionRows``."""

    def __init__(self, response: Array, rhs: Array) -> None:
        self._response, self.rhs = response, rhs

    @property
    def values(self) -> Array:
        """See ``arm.MotionRows``."""
        return np.concatenate([np.ones(len(self.rhs)), -self._response.reshape(-1)])

    def response(self) -> tuple[Array, Array]:
        """Return K and r."""
        return self._response, self.rhs


class ChainKinematics:
    """See ``arm.Kinematics``."""

    def __init__(self, chain: SerialChain, *, compiled: bool) -> None:
        q = ca.MX.sym("q", len(chain) + 6)
        X, jacobian = chain.moving(q, *(ca.DM(part.T) for part in chain.geometry.values()))
        nodes, rotations = chain.station_nodes, chain.station_frames
        home = chain.home_nodes[nodes]
        frames = frames_at(X, home, rotations, nodes)
        tip = frames_at(X, home[-1:], rotations[-1:], nodes[-1:])
        self._kernel = Kernel(ca.Function("chain_arm", [q], [X, jacobian, *frames, *tip]), compiled=compiled)
        self._chain, outputs = chain, self._kernel.outputs
        self.quantities, self.gradient = np.zeros(len(chain)), np.zeros((0, 0, 3))
        self._jacobian = outputs[1].reshape(len(chain), -1).T
        self.station_rotation = outputs[2].reshape(-1, 3, 3).transpose(0, 2, 1)
        self.station_spin = outputs[3].reshape(-1, 9, 3).transpose(0, 2, 1)
        self.tip_rotation, self.tip_spin = outputs[4].reshape(3, 3).T, outputs[5].reshape(9, 3).T

    def evaluate(self, q: Array) -> None:
        """See ``arm.Kinematics``."""
        self._kernel.inputs[0][:] = q
        self._kernel()
        self.quantities[:] = q[: len(self._chain)]

    evaluate_quantities = evaluate

    def motion(self) -> ChainRows:
        """See ``arm.Kinematics``."""
        rows = (3 * self._chain.free[:, None] + np.arange(3)).reshape(-1)
        return ChainRows(self._jacobian[np.ix_(rows, self._chain.actuators)], np.zeros(len(rows)))
