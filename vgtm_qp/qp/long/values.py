"""From the positions of a long arm's nodes to the numbers of its QP: every period by one mapped, compiled function."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.frames import fitted_frame, frame_constants
from vgtm_qp.compiled import Kernel
from vgtm_qp.qp.long.chain import Chain
from vgtm_qp.qp.long.chain_data import ChainData
from vgtm_qp.qp.long.elimination import member_lengths

Array = NDArray[np.float64]


def period_values(chain: Chain) -> ca.Function:
    """Return one period's numbers as a function of where its nodes are.

    Arguments: X, Y (3, w + m), where residuals and where Jacobians are evaluated; home (3m), lengths, and fixed (3m),
    1 where a member keeps it; frames (7f), polar angles' cosines and sines and the sense of each face; alignment
    (3, 3f); curve (12f), for each face its point, the point's displacement with the base, the slope and that slope's
    displacement; switches (2), motion and gap.

    Results: ``head`` and ``tail`` of ``elimination.Inputs``, ``ChainData.lean`` and the lengths (3m) at X.
    """
    layout, faces = chain.layout, chain.faces.shape[1]
    size = len(chain.carried) + chain.nodes.shape[1]
    X, Y = ca.SX.sym("X", 3, size), ca.SX.sym("Y", 3, size)
    home, fixed = ca.SX.sym("home", chain.own), ca.SX.sym("fixed", chain.own)
    frames, alignment = ca.SX.sym("frames", 7 * faces), ca.SX.sym("alignment", 3, 3 * faces)
    curve, switches = ca.SX.sym("curve", 12 * faces), ca.SX.sym("switches", 2)
    motion, gap_on = switches[0], switches[1]

    lengths = member_lengths(chain, X)
    jacobian = ca.SX(chain.own, 3 * size)
    for row, (first, second) in enumerate(chain.member_places.tolist()):
        along = Y[:, second] - Y[:, first]
        along = along.T * (1.0 / ca.norm_2(along))
        jacobian[row, 3 * first : 3 * first + 3] = -along
        jacobian[row, 3 * second : 3 * second + 3] = along
    soft = np.flatnonzero(chain.soft).tolist()
    centring = layout.weights.stroke_centring
    pattern = ca.Sparsity.triplet(
        *chain.coordinate_pattern.shape, *map(list, np.nonzero(chain.coordinate_pattern))
    )
    head = [ca.vec(ca.project(jacobian, pattern).nz[:]), fixed * (home - lengths)]
    tail = [motion * centring * ((1.0 - fixed) * (lengths - home))[soft]]
    tangent_faces, tangent_curves, gaps, tilts, leans = [], [], [], [], []
    for k in range(faces):
        places = chain.face_places[k].tolist()
        angles = frames[7 * k : 7 * k + 7]
        frame = (angles[:3], angles[3:6], angles[6])
        x, moved, slope, slope_moved = ca.vertsplit(curve[12 * k : 12 * k + 12], 3)
        axes = (fitted_frame(X[:, places], *frame) @ alignment[:, 3 * k : 3 * k + 3])[:, :2]
        slowness = 1.0 / ca.norm_2(slope)
        tangent = slope * slowness
        along = axes.T @ tangent
        lean = (axes.T - along @ tangent.T) * slowness
        turn = ca.vertcat(*[_turning(Y[:, places], frame, ca.cross(axes[:, a], tangent)) for a in range(2)])
        tangent_faces.append(ca.vec(turn.T))
        tangent_curves.append(ca.vec(lean.T))
        leans.append(ca.vec(lean.T @ lean))
        centre = X[:, places] @ ca.DM(chain.face_weights[k])
        gaps.append(gap_on * (centre - x) - moved)
        tilts.append(motion * along + lean @ slope_moved)
    head += tangent_faces
    tail += tangent_curves + gaps + tilts
    outputs = [ca.vertcat(*head), ca.vertcat(*tail), ca.vertcat(*leans), lengths]
    inputs = [X, Y, home, fixed, frames, alignment, curve, switches]
    return ca.Function("values", inputs, [ca.densify(output) for output in outputs])


def _turning(nodes: ca.SX, frame: tuple[ca.SX, ca.SX, ca.SX], axis: ca.SX) -> ca.SX:
    """Return (1, 9) the component along `axis` of a face's angular velocity, by the velocities of `nodes` (3, 3).

    Half the sum of r x dr over the frame's axes r, in one sweep backwards through what places them.
    """
    fitted = fitted_frame(nodes, *frame)
    across = ca.horzcat(*[ca.cross(axis, fitted[:, c]) for c in range(3)]) / 2
    return ca.jtimes(ca.vec(fitted), ca.vec(nodes), ca.vec(across), True).T


class PeriodValues:
    """Fills :class:`ChainData` from the positions of the nodes.

    Attributes
    ----------
    lengths : (M,)
        Of the members at the configuration evaluated last, m.
    """

    def __init__(self, chain: Chain, data: ChainData, home_lengths: Array) -> None:
        if chain.window is None:
            raise ValueError("the periods of this chain are not alike")
        layout, bays, order = chain.layout, chain.bays, data.order
        self._layout, self._data = layout, data
        self._kernel = Kernel(period_values(chain).map(chain.periods))
        for k, array in enumerate((data.head, data.tail, data.lean)):
            self._kernel.bind_output(k, array)
        inputs = [array.reshape(chain.periods, -1) for array in self._kernel.inputs]
        self._X, self._Y = (array.reshape(-1, 3) for array in inputs[:2])
        self._curve, self._switches = inputs[6], inputs[7]
        self._window = chain.window[order].reshape(-1)
        members = chain.members[order]
        inputs[2][:], inputs[3][:] = home_lengths[members], ~bays.actuated[members]
        self._at = np.argsort(members.reshape(-1))
        self._frames(chain, inputs[4], inputs[5])
        weights, slopes = layout.curve_weights[data.faces], layout.curve_slopes[data.faces]
        self._tables = weights, slopes
        # The first period of the base end: what its members hang on does not move by itself.
        self._first = -1 if data.is_reversed else 0
        columns = np.nonzero(chain.coordinate_pattern.T)[0]
        self._of_base = np.flatnonzero(columns < chain.before)
        rows = np.nonzero(chain.coordinate_pattern.T)[1]
        self._base_row, self._base_column = rows[self._of_base], columns[self._of_base]
        self._base = chain.window[0, : len(chain.carried)]
        self._jacobian = data.head[:, : len(columns)]
        self._rhs = data.head[:, len(columns) : len(columns) + chain.own]
        self._entry = _entries(chain)
        self._members_at = np.empty(bays.member_count, dtype=np.int64)
        self._members_at[members.reshape(-1)] = np.arange(bays.member_count)
        self._nodes = chain.window[order]
        self.lengths = np.zeros(bays.member_count)

    def _frames(self, chain: Chain, frames: Array, alignments: Array) -> None:
        arm, order = chain.layout.arm, chain.face_order[self._data.order].reshape(-1, 3)
        angles, aligned = [], []
        for face, places in zip(chain.layout.tracked[self._data.faces].tolist(), order, strict=True):
            cosines, sines, alignment = frame_constants(
                arm.home[arm.stations.nodes[face]], arm.stations.frames[face]
            )
            sense = 1.0 if (np.roll(places, -int(places.argmin())) == np.arange(3)).all() else -1.0
            angles.append(np.concatenate([cosines[places], sines[places], [sense]]))
            aligned.append(alignment.T.reshape(-1))
        if angles:
            frames[:] = np.array(angles).reshape(frames.shape)
            alignments[:] = np.array(aligned).reshape(alignments.shape)

    def fill(self, X: Array, Y: Array, vertices: Array, moved: Array | None, *, motion: bool) -> None:
        """Overwrite the QP's numbers with those at `X` (N, 3), with Jacobians at `Y` (N, 3), m.

        What the base makes of the curve is in the data already. `moved` (N, 3) are displacements of the base nodes, m,
        None where they rest.
        """
        data = self._data
        np.take(X, self._window, axis=0, out=self._X, mode="clip")
        np.take(Y, self._window, axis=0, out=self._Y, mode="clip")
        self._switches[:] = motion, motion or self._layout.hard_tracking
        if len(data.faces):
            weights, slopes = self._tables
            both = np.hstack([vertices, data.offset])
            curve = self._curve.reshape(-1, 2, 6)
            np.matmul(weights, both, out=curve[:, 0])
            np.matmul(slopes, both, out=curve[:, 1])
        self._kernel()
        np.take(self._kernel.outputs[3], self._at, out=self.lengths, mode="clip")
        first = self._jacobian[self._first]
        if moved is not None:
            shift = moved[self._base].reshape(-1)
            np.subtract.at(
                self._rhs[self._first], self._base_row, first[self._of_base] * shift[self._base_column]
            )
        first[self._of_base] = 0.0

    def member_rows(self, members: NDArray[np.int64]) -> tuple[NDArray[np.int64], Array]:
        """Return nodes (R, w + m) and the gradient (R, w + m, 3) of the lengths of `members` (R,)."""
        period, row = np.divmod(self._members_at[members], len(self._entry))
        entry = self._entry[row]
        values = np.where(entry >= 0, self._jacobian[period[:, None, None], entry], 0.0)
        return self._nodes[period], values


def _entries(chain: Chain) -> NDArray[np.int64]:
    """Return (3m, w + m, 3): where among a period's nonzeros a member's gradient is; -1 where it has none."""
    pattern = chain.coordinate_pattern
    number = np.full(pattern.shape, -1, dtype=np.int64)
    number.T[pattern.T] = np.arange(int(pattern.sum()))
    return number.reshape(len(pattern), -1, 3)
