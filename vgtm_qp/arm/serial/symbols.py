"""A serial arm in CasADi's symbols: K is the geometric Jacobian, and there is nothing to eliminate."""

from __future__ import annotations

from typing import Any

import casadi as ca

from vgtm_qp.arm.serial.chain import SerialChain
from vgtm_qp.arm.symbols import ArmSymbols, Constants
from vgtm_qp.arrays import Array, Index


class ChainSymbols(ArmSymbols):
    """See ``arm.ArmSymbols``; joints at `home` (J,), `actuators` (n_a,) among them, and `free` nodes (N - N_c,)."""

    def __init__(
        self, chain: SerialChain, home: Array, actuators: Index, free: Index, constants: Constants
    ) -> None:
        super().__init__(home, actuators, constants)
        self._joints, self._free = len(chain), free.tolist()
        self._nodes, self._moving = chain.functions
        self.shape, self.given = (len(chain) + 6, 1), list(range(chain.node_count))
        self._constants = [constants.add(name, value) for name, value in chain.constants.items()]

    def nodes(self, q: ca.MX) -> ca.MX:
        return self._nodes(q, *self._constants)

    def quantities(self, q: ca.MX) -> ca.MX:
        """See ``arm.ArmSymbols``: the joints' values."""
        return q[: self._joints]

    def motion(self, q: ca.MX, at: ca.MX, moved: ca.MX) -> list[ca.MX]:  # noqa: ARG002
        """See ``arm.ArmSymbols``: K and r."""
        rows = [3 * node + axis for node in self._free for axis in range(3)]
        _, jacobian = self._moving(at, *self._constants)
        return [jacobian[rows, self._actuators], ca.vec(moved[:, self._free])]

    def response(self, q: ca.MX, at: ca.MX, moved: ca.MX) -> ca.MX:
        return ca.horzcat(*self.motion(q, at, moved))

    def coordinates(self, nodes: Any, strokes: Any) -> Any:  # noqa: ARG002
        """See ``arm.ArmSymbols``: the actuators."""
        return strokes

    def along(self, q: ca.MX, coordinates: ca.MX) -> ca.MX:
        q = q * 1.0
        q[self._actuators] = q[self._actuators] + coordinates
        return q

    def closed(self, q: ca.MX, lower: ca.MX, upper: ca.MX) -> ca.MX:
        return ca.vertcat(self.aims(self.quantities(q), lower, upper), q[self._joints :])
