"""A serial arm in CasADi's symbols: K is the geometric Jacobian, and there is nothing to eliminate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from vgtm_qp.arm.serial.chain import SerialChain
from vgtm_qp.arm.symbols import Constants


class ChainSymbols:
    """See ``arm.ArmSymbols``: K is the geometric Jacobian, and there is nothing to eliminate."""

    can_eliminate = True

    def __init__(self, chain: SerialChain, constants: Constants) -> None:
        self._joints, self._free, self._actuators = len(chain), chain.free.tolist(), chain.actuators.tolist()
        self.shape, self.given = (len(chain) + 6, 1), list(range(len(chain.node_names)))
        self.home = constants.add("home", chain.home)
        self._geometry = [constants.add(name, part) for name, part in chain.geometry.items()]
        self._place, self._move = chain.nodes, chain.moving
        self._fixed = np.flatnonzero(chain.locked).tolist()

    def nodes(self, q: ca.MX) -> ca.MX:
        """See ``arm.ArmSymbols``."""
        return self._place(q, *self._geometry)

    def quantities(self, q: ca.MX) -> ca.MX:
        """See ``arm.ArmSymbols``: the joints' values."""
        return q[: self._joints]

    def motion(self, q: ca.MX, at: ca.MX, moved: ca.MX) -> list[ca.MX]:  # noqa: ARG002
        """See ``arm.ArmSymbols``."""
        rows = [3 * node + axis for node in self._free for axis in range(3)]
        jacobian = self._move(at, *self._geometry)[1]
        return [jacobian[rows, self._actuators], ca.vec(moved[:, self._free])]

    def response(self, q: ca.MX, at: ca.MX, moved: ca.MX) -> ca.MX:
        """See ``arm.ArmSymbols``."""
        return ca.horzcat(*self.motion(q, at, moved))

    def coordinates(self, nodes: Any, strokes: Any) -> Any:  # noqa: ARG002
        """See ``arm.ArmSymbols``: the actuators."""
        return strokes

    def along(self, q: ca.MX, coordinates: ca.MX) -> ca.MX:
        """See ``arm.ArmSymbols``."""
        q = q * 1.0
        q[self._actuators] = q[self._actuators] + coordinates
        return q

    def closed(self, q: ca.MX, lower: ca.MX, upper: ca.MX) -> ca.MX:
        """See ``arm.ArmSymbols``."""
        q = q * 1.0
        q[self._actuators] = ca.fmax(lower, ca.fmin(upper, q[self._actuators]))
        for joint in self._fixed:
            q[joint] = self.home[joint]
        return q

    def error(self, quantities: ca.MX, lower: ca.MX, upper: ca.MX) -> ca.MX:
        """See ``arm.ArmSymbols``."""
        values = quantities[self._actuators]
        beyond = ca.fmax(ca.fmax(values - upper, lower - values), 0.0)
        return ca.norm_2(ca.vertcat(beyond, *(quantities[k] - self.home[k] for k in self._fixed)))

    def held(self, tracked: Sequence[int]) -> Callable[[Any, Any], Any] | None:  # noqa: ARG002
        """See ``arm.ArmSymbols``: stations alone do not determine the joints."""
        return None
