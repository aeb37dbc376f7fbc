"""From the positions of a long arm's nodes to the numbers of its QP: every period by one mapped, compiled function."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.frames import fitted_frame, frame_constants, turning
from vgtm_qp.compiled import Kernel
from vgtm_qp.qp.long.chain import Chain
from vgtm_qp.qp.long.chain_data import ChainData
from vgtm_qp.qp.long.elimination import member_lengths
from vgtm_qp.qp.long.sparse_symbols import dense_function, nonzeros, sparsity_of
from vgtm_qp.rows import tracking

Array = NDArray[np.float64]


def period_values(chain: Chain) -> ca.Function:
    """Return one period's numbers as a function of where its nodes are.

    Arguments: X, Y (3, w + m), where residuals and where Jacobians are evaluated; home (3m), lengths, and fixed (3m),
    1 where a member keeps it; angles (6f), polar angles' cosines and sines of each face; alignment (3, 3f); curve
    (12f), for each face its point, the point's displacement with the base, the slope and that slope's displacement;
    switches (2), motion and gap.

    Results: ``head`` and ``tail`` of ``elimination.Inputs``, ``ChainData.lean`` and the lengths (3m) at X.
    """
    layout, faces = chain.layout, chain.faces.shape[1]
    X, Y = (ca.SX.sym(name, 3, chain.window.shape[1]) for name in "XY")
    home, fixed = ca.SX.sym("home", chain.own), ca.SX.sym("fixed", chain.own)
    angles, alignment = ca.SX.sym("angles", 6 * faces), ca.SX.sym("alignment", 3, 3 * faces)
    curve, switches = ca.SX.sym("curve", 12 * faces), ca.SX.sym("switches", 2)
    motion, gap_on = switches[0], switches[1]

    lengths, soft = member_lengths(chain, X), np.flatnonzero(chain.soft).tolist()
    jacobian = ca.jacobian(member_lengths(chain, Y), ca.vec(Y))
    head = [nonzeros(ca.project(jacobian, sparsity_of(chain.pattern))), fixed * (home - lengths)]
    tail = [motion * layout.weights.stroke_centring * ((1.0 - fixed) * (lengths - home))[soft]]
    turns, leans, gaps, tilts, products = [], [], [], [], []
    for k, places in enumerate(chain.face_places.tolist()):
        polar, nodes = ca.vertsplit(angles[6 * k : 6 * k + 6], 3), Y[:, places]
        rotation = fitted_frame(X[:, places], *polar) @ alignment[:, 3 * k : 3 * k + 3]
        point, moved, slope, slope_moved = ca.vertsplit(curve[12 * k : 12 * k + 12], 3)
        tilt, c, lean = tracking.slope_rows(rotation, slope)
        turns.append(ca.vec(turning(fitted_frame(nodes, *polar), nodes, c).T))
        leans.append(ca.vec(lean.T))
        products.append(ca.vec(lean.T @ lean))
        centre = X[:, places] @ ca.DM(chain.face_weights[k])
        gaps.append(gap_on * tracking.gap(centre, point) - moved)
        tilts.append(motion * tilt + lean @ slope_moved)
    outputs = [
        ca.vertcat(*head, *turns),
        ca.vertcat(*tail, *leans, *gaps, *tilts),
        ca.vertcat(*products),
        lengths,
    ]
    return dense_function("values", [X, Y, home, fixed, angles, alignment, curve, switches], outputs)


class PeriodValues:
    """Fills :class:`ChainData` from the positions of the nodes.

    Attributes
    ----------
    lengths : (M,)
        Of the members at the configuration evaluated last, m.
    """

    def __init__(self, chain: Chain, data: ChainData) -> None:
        layout, bays = chain.layout, chain.bays
        self._chain, self._data = chain, data
        self._kernel = Kernel(period_values(chain).map(chain.periods))
        for k, array in enumerate((data.head, data.tail, data.lean)):
            self._kernel.bind_output(k, array)
        inputs = [array.reshape(chain.periods, -1) for array in self._kernel.inputs]
        self._X, self._Y = (array.reshape(-1, 3) for array in inputs[:2])
        self._curve, self._switches = inputs[6].reshape(-1, 2, 6), inputs[7]
        inputs[2][:], inputs[3][:] = layout.arm.home_quantities[data.members], ~bays.actuated[data.members]
        for array, constants in zip(inputs[4:6], _frame_constants(chain, data), strict=True):
            array[:] = constants.reshape(array.shape)
        # What the first period's members hang on does not move by itself.
        self._first = -1 if data.is_reversed else 0
        self._base_row, self._base_column = np.nonzero(chain.pattern[:, : chain.before])
        self._of_base = chain.entry[self._base_row, self._base_column]
        self.lengths = np.zeros(bays.member_count)

    def fill(self, X: Array, Y: Array, vertices: Array, moved: Array | None, *, motion: bool) -> None:
        """Overwrite the QP's numbers with those at `X` (N, 3), with Jacobians at `Y` (N, 3), m.

        What the base makes of the curve is in the data already. `moved` (N, 3) are displacements of the base nodes, m,
        None where they rest.
        """
        chain, data = self._chain, self._data
        window = data.window.reshape(-1)
        np.take(X, window, axis=0, out=self._X, mode="clip")
        np.take(Y, window, axis=0, out=self._Y, mode="clip")
        self._switches[:] = motion, motion or chain.layout.hard_tracking
        if len(data.faces):
            both = np.hstack([vertices, data.offset])
            np.matmul(data.weights, both, out=self._curve[:, 0])
            np.matmul(data.slopes, both, out=self._curve[:, 1])
        self._kernel()
        np.take(self._kernel.outputs[3], data.at, out=self.lengths, mode="clip")
        first = data.part["jacobian"][self._first]
        if moved is not None:
            shift = moved[chain.window[0]].reshape(-1)[self._base_column]
            np.subtract.at(data.part["rhs"][self._first], self._base_row, first[self._of_base] * shift)
        first[self._of_base] = 0.0


def _frame_constants(chain: Chain, data: ChainData) -> tuple[Array, Array]:
    """Return angles (K, 6) and alignments (K, 3, 3), columns first, of the faces in the order of `data`.

    A face whose nodes are named the other way round has y- and z-axis of its fitted frame reversed.
    """
    arm, angles, alignments = chain.layout.arm, [], []
    for face, order in zip(
        chain.layout.tracked[data.faces].tolist(), data.face_order.reshape(-1, 3), strict=True
    ):
        home, frame = arm.home[arm.stations.nodes[face]], arm.stations.frames[face]
        cosines, sines, alignment = frame_constants(home, frame)
        sense = 1.0 if (np.roll(order, -int(order.argmin())) == np.arange(3)).all() else -1.0
        angles.append(np.concatenate([cosines[order], sense * sines[order]]))
        alignments.append((np.array([1.0, sense, sense])[:, None] * alignment).T)
    return np.array(angles), np.array(alignments)
