"""`Arm`, the interface of all arms: everything that a step may use of one.

An arm is a configuration q that places points in space, its *nodes* X = p(q) of shape (N, 3). The nodes of a
truss are its joints, and their positions are q itself; the nodes of a serial arm are the origins of its
frames. *Bodies* are spanned by points of the arm. *Stations* are poses made of nodes: they track the
reference curve, and the last station is the end effector.

An arm is moved by its *quantities* [c; a]: fixed ones, c(q) = const, and actuated ones a(q), which have
boxes. There are as many quantities as coordinates of q, so that to first order the nodes move by K d_a + r.

Rows and steps know no more of an arm than this. What goes along a truss is for arms with ``bays``, which a serial arm
has not: the eliminations of ``qp/bays.py`` and ``qp/long``. The resolvers in ``methods`` also ask for an arm's class.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.symbols import ArmSymbols, Bound, Constants, Frames
from vgtm_qp.arrays import Array, Index, Mask
from vgtm_qp.compiled import Kernel
from vgtm_qp.geometry.bodies import Bodies
from vgtm_qp.rows.members import LengthScatter

GRAVITY = np.array([0.0, 0.0, -9.81])
"""m/s^2."""
RANK_TOLERANCE = 1e-8
"""Singular values of a Jacobian below this fraction of the greatest one count as zero."""

_FEW_STATIONS = 20
"""Up to this many stations, a second compiled function without stations costs more than it saves."""


class Label(NamedTuple):
    """Name, kind and unit of a row or column of the QP."""

    name: str
    kind: str
    unit: str


class Pose(NamedTuple):
    """Pose of the base: its origin (3,), m, and rotation (3, 3) relative to its home pose."""

    position: Array
    rotation: Array

    def carry(self, points: Array, after: Pose) -> Array:
        """Return `points` (K, 3), m, moved with the base from this pose to the pose `after`."""
        turn = after.rotation @ self.rotation.T
        return np.asarray((points - self.position) @ turn.T + after.position)


@dataclass(frozen=True, eq=False)
class Stations:
    """Poses along the arm that track the curve's nodes, the base first.

    Attributes
    ----------
    nodes : (F, 3) int
        The nodes that each pose is made of.
    weights : (F, 3)
        Weights whose mean of the nodes is the station's position.
    frames : (F, 3, 3)
        Rotations at home, columns x, y, z in the base frame; z along the arm.
    trackable : tuple of str
        Coordinates every `stride`-th station can keep on the curve exactly: "position", "pointing", "orientation".
    stride : int
    word : str
        Word for a station in names: ``"face"`` or ``"joint"``.
    """

    nodes: Index
    weights: Array
    frames: Array
    trackable: tuple[str, ...] = ("position",)
    stride: int = 1
    word: str = "face"

    def __len__(self) -> int:
        return len(self.nodes)

    def centres(self, X: Array) -> Array:
        """Return (F, 3) the positions of the stations for nodes at `X` (N, 3), m."""
        return np.asarray(np.einsum("fk,fkc->fc", self.weights, X.take(self.nodes, axis=0)))


@dataclass(frozen=True, eq=False)
class Tip:
    """The end effector: its nodes (K,), their weights (K,), and its rotation at home (3, 3).

    It has an orientation if it has three nodes or more.
    """

    nodes: Index
    weights: Array
    frame: Array

    @property
    def has_frame(self) -> bool:
        """Whether the end effector has an orientation."""
        return len(self.nodes) >= 3

    def position(self, X: Array) -> Array:
        """Return (3,) the position of the end effector, eq. (1), for nodes at `X` (N, 3), m."""
        return np.asarray(self.weights @ X.take(self.nodes, axis=0))


class Ends(NamedTuple):
    """Points of bodies that are functions of several nodes each, for C.

    Attributes
    ----------
    place : Kernel
        A function of its own, q -> all points (3, P).
    row : Kernel
        A function of its own, (nodes (3, 3), offset (3)) of a point -> the point, its derivatives (3, 9) by the nodes.
    nodes, offset : (P, 3) int, (P, 3)
    """

    place: Kernel
    row: Kernel
    nodes: Index
    offset: Array


class Arithmetic(NamedTuple):
    """An arm in arrays and functions for C, where one call takes the whole step.

    Attributes
    ----------
    place : Kernel or None
        A function of its own, q -> nodes (3, N); None where the nodes are the configuration.
    bend : Kernel or None
        A function of its own, (q, q) -> bounds (2 or more); the greater of the first two is four times
        ``Arm.deviation``. None where nodes move straight when q does.
    distances : bool
        Whether quantity m is the distance of the points ``first[m]`` and ``last[m]``. If it is not, it is coordinate
        ``first[m]`` of q less ``multiplier[m]`` times the coordinate ``last[m]``.
    first, last, multiplier : (M,)
    levers : array or None
        Factors of the coordinates' displacements whose sum is ``Arm.travel`` while the base rests; None where that is
        the greatest displacement.
    based : int array
        Coordinates of q that only the base moves.
    ends : Ends or None
        The points of the bodies; None where these are the nodes.
    """

    place: Kernel | None
    bend: Kernel | None
    distances: bool
    first: Index
    last: Index
    multiplier: Array
    levers: Array | None
    based: Index
    ends: Ends | None = None


class Description(Protocol):
    """A dataclass of counts that prints as text for people."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __str__(self) -> str: ...


class MotionPattern(NamedTuple):
    """Sparsity of the rows that tie nodes to actuators: rows and columns (E,) of the nonzeros, and the rows' labels.

    Columns are those of the free nodes' displacements, 3 (N - N_c), followed by the n_a actuators'.
    """

    rows: Index
    columns: Index
    labels: tuple[Label, ...]


class MotionRows(Protocol):
    """How the free nodes move with the actuators, to first order at one configuration."""

    @property
    def values(self) -> Array:
        """The nonzeros (E,) at the places of the arm's :class:`MotionPattern`."""
        ...

    @property
    def rhs(self) -> Array:
        """The rows' right-hand sides, m."""
        ...

    def response(self) -> tuple[Array, Array]:
        """Return K (3 (N - N_c), n_a) and r (3 (N - N_c),).

        Raises
        ------
        SolverError
            The arm is in a singular pose.
        """
        ...

    def over_actuators(self, rows: Array) -> Array:
        """Return rows (R, 3 (N - N_c)) over the free nodes' displacements as rows (R, n_a) over the actuators' changes.

        The work is proportional to R, and to the length of the arm; SolverError as :meth:`response`.
        """
        ...


class LengthRowsLike(Protocol):
    """Rows of lengths: gradients (M, Q, 3) by the nodes each depends on, and right-hand sides (M,)."""

    gradient: Array
    rhs: Array


class Approach(Protocol):
    """Bounds of how much nearer bodies can come to other bodies, or to something at rest."""

    def __call__(self, body: Index, other: Index | None = None) -> Array:
        """Return (R,) bounds, m, for bodies (R,) and other bodies (R,); NaN or inf if none is known."""
        ...


class Bays(Protocol):
    """The bays of an arm, for speed alone: the order of its members, as in ``truss.Truss``."""

    @property
    def joints(self) -> object: ...
    @property
    def node_count(self) -> int: ...
    @property
    def member_count(self) -> int: ...
    @property
    def base(self) -> Mask: ...
    @property
    def stage(self) -> Index: ...
    @property
    def free(self) -> Index: ...
    @property
    def member_nodes(self) -> Index: ...
    @property
    def actuated(self) -> Mask: ...
    @property
    def actuators(self) -> Index: ...
    @property
    def scatter(self) -> LengthScatter: ...


class Arm(ABC):
    """What a step knows of an arm.

    Attributes
    ----------
    kind : str
        Name of the arm's kind: the module of a truss, or ``"serial"``.
    bays : Bays or None
        Structure of the arm that eliminations use; None without one.
    leaves_chords : bool
        True if points leave their straight chords when the configuration moves straight, see :meth:`deviation`.
    segments : int
        Number of bays or joints.
    node_names : tuple of str
        Length N.
    home_configuration : configuration
    home : (N, 3)
        Nodes at home, m.
    base : (N,) bool
        Nodes that move with the base, eq. (7).
    free : (N - N_c,) int
        The others, eq. (9), in the order in which they can be eliminated.
    quantity_names : tuple of str
        Length M: fixed and actuated quantities.
    home_quantities : (M,)
    actuated : (M,) bool
    actuator_units : (n_a,) str
        ``"m"`` or ``"rad"``.
    stroke, rate, acceleration : (M, 2), (M,), (M,)
        Least and greatest values; greatest rates; greatest accelerations; inf without a limit.
    effort : (M,) or None
        What the quantities may bear at most, N m or N; inf without a limit, None if no limits are known.
    mass : float
        Of what is known to move, kg; 0 for trusses.
    stations : Stations
        Empty where nothing tracks a curve.
    end_effector : Tip
    height : float
        Length of the axis from the base to the tip at home, m.
    unit : float
        The characteristic length: mean distance of the nodes that a member or link joins, at home, m. Tolerances and
        weights of lengths are shares of it, so that an arm moves in the same way whatever its size.
    bodies : Bodies
        Spanned by the points of :meth:`points`.
    """

    kind: str
    bays: Bays | None
    leaves_chords: bool
    segments: int
    node_names: tuple[str, ...]
    home_configuration: Array
    home: Array
    base: Mask
    free: Index
    quantity_names: tuple[str, ...]
    home_quantities: Array
    actuated: Mask
    actuator_units: tuple[str, ...]
    stroke: Array
    rate: Array
    acceleration: Array
    effort: Array | None = None
    mass: float = 0.0
    stations: Stations
    end_effector: Tip
    height: float
    unit: float
    bodies: Bodies

    @cached_property
    def actuators(self) -> Index:
        """(n_a,) indices of the actuated quantities."""
        return np.flatnonzero(self.actuated)

    @cached_property
    def levers(self) -> Array:
        """(n_a,) lengths, m, to compare changes of actuators by: 1 for lengths, :attr:`unit` for angles."""
        return np.array([self.unit if unit == "rad" else 1.0 for unit in self.actuator_units])

    @property
    def fineness(self) -> float:
        """Factor of the published tolerances of lengths: they are finer for arms whose :attr:`unit` is below 1 m."""
        return min(1.0, self.unit)

    @property
    @abstractmethod
    def motion_pattern(self) -> MotionPattern: ...

    @abstractmethod
    def symbols(self, constants: Constants) -> ArmSymbols:
        """Return the arm in symbols, and add its constants to `constants`."""

    @abstractmethod
    def motion_rows(self, *values: Array) -> MotionRows:
        """Return the rows from the values of ``ArmSymbols.motion``."""

    def kinematics(self, *, compiled: bool = True) -> Kinematics:
        """Return the arm at one configuration, in arrays."""
        return Kinematics(self, compiled=compiled)

    @abstractmethod
    def measured(self, q: Array) -> Array:
        """Return (M,) the quantities by plain arithmetic, which shares no code with :meth:`symbols` and kinematics."""

    @abstractmethod
    def based(self, q: Array, pose: Pose) -> Array:
        """Return the configuration with its base at `pose` and all else unchanged; eqs. (7)-(8)."""

    def carried(self, q: Array, before: Pose, after: Pose) -> Array:  # noqa: ARG002
        """Return the configuration that moves as a rigid body with its base from one pose to another."""
        return self.based(q, after)

    @abstractmethod
    def advanced(self, q: Array, nodes: Array, strokes: Array) -> Array:
        """Return the configuration after consistent displacements of nodes (N, 3) and actuators (n_a,)."""

    @abstractmethod
    def newton(self, tracked: Index | None = None) -> Newton:
        """Return the Newton step that changes the quantities by what they miss, (M,).

        If the indices of `tracked` stations (K,) are given, which must determine the configuration together with the
        fixed quantities, those are followed by the displacements (3K,) that the stations miss, and actuators are free.
        The step raises SolverError in a singular pose.
        """

    @abstractmethod
    def forces(self, q: Array, load: Array, gravity: Array | None = None) -> Array:
        """Return (M,) what the quantities bear at rest where a force `load` (3,), N, pulls at the end effector.

        By virtual work: forces of lengths, N, tension positive, and torques about joints, N m. With `gravity` (3,),
        m/s^2, they bear the arm's own :attr:`mass` too; trusses have none.

        Raises
        ------
        SolverError
            The arm is in a singular pose.
        """

    @abstractmethod
    def nodes(self, q: Array) -> Array:
        """Return (N, 3) the nodes at a configuration, m."""

    def arithmetic(self) -> Arithmetic | None:
        """Return what C has to know of the arm; None where it cannot take its steps."""
        return None

    def points(self, q: Array) -> Array:
        """Return (P, 3) the points that span the bodies, m; by default the nodes."""
        return self.nodes(q)

    def ways(self, start: Array, end: Array, pieces: int) -> Array:
        """Return (K + 1, P, 3) the points, m, at the ends of K equal `pieces` of a straight motion of q."""
        return np.stack([self.points(q) for q in between(start, end, pieces)])

    def over_nodes(self, q: Array, points: Index, coefficients: Array) -> tuple[Index, Array]:  # noqa: ARG002
        """Return rows over displacements of points as rows over displacements of nodes.

        Takes `points` (R, 4) and `coefficients` (R, 4, 3); returns nodes (R, S) and coefficients (R, S, 3).
        """
        return points, coefficients

    @abstractmethod
    def deviation(self, start: Array, end: Array) -> float:
        """Return a bound, m, of how much nearer two points come than their chords when q moves straight."""

    @abstractmethod
    def tip_deviation(self, start: Array, end: Array, reach: float) -> float:
        """Return a bound, m, of how far what is fixed to the end effector leaves its chord when q moves straight.

        It holds for points within `reach`, m, of the end effector, which has a frame.
        """

    @abstractmethod
    def travel(self, motion: Array) -> float:
        """Return a bound of how far a node's coordinate moves in a displacement of the configuration, m."""

    def furthest(self, q: Array, lower: Array, upper: Array) -> Array | None:  # noqa: ARG002
        """Return a displacement with the greatest move of each actuator in its box (n_a,); None if unknown.

        The arm need not be able to move so. Its :meth:`approach` bounds that of any motion within the boxes.
        """
        return None

    def approach(self, motion: Array) -> Approach | None:  # noqa: ARG002
        """Return how much nearer bodies come in a displacement of the configuration; None if unknown.

        The base is at rest.
        """
        return None

    @abstractmethod
    def reach(self) -> Array:
        """Return (N_c,) a bound of the distance from each base node to the tip in any pose, m; inf where unknown."""

    def hollow(self) -> float:
        """Return a bound of the distance from the tip to the nearest point on the axis of a body, m."""
        return 0.0

    def unreachable(self) -> tuple[str, ...]:
        """Return in words the tip motions that no actuator can start at home."""
        return ()

    @abstractmethod
    def describe(self) -> Description:
        """Return the arm's counts, and what its stations or its tip can do."""

    def record(self) -> dict[str, Any]:
        """Return the arm as JSON data for verification.

        Keys of every arm: ``actuated``, ``stroke`` (M, 2), ``rate`` and ``acceleration`` of its quantities, and the
        ``radius`` of its bodies. None means no limit.
        """
        return {
            "actuated": self.actuated.tolist(),
            "stroke": [_or_none(limits) for limits in self.stroke],
            "rate": _or_none(self.rate),
            "acceleration": _or_none(self.acceleration),
            "radius": self.bodies.radius.tolist(),
        }

    @abstractmethod
    def recorded(self, q: Array, quantities: Array) -> dict[str, Any]:
        """Return the arrays of a result file for configurations (T, ...) and quantities (T, M)."""


Newton = Callable[[Array, Array, "Kinematics"], Array]
"""(q, what is missing there, kinematics evaluated there) -> the next configuration."""


class Kinematics:
    """An arm at one configuration, in arrays that are overwritten by `evaluate`: its symbols as one compiled function.

    Attributes
    ----------
    quantities : (M,)
        Fixed and actuated quantities, in their units.
    gradient : (M, Q, 3)
        Of the quantities by the nodes they depend on, see ``Bays.member_nodes``; empty without bays.
    station_rotation, station_spin : (F, 3, 3), (F, 3, 9)
        Rotations of the stations, and their angular-velocity rows with respect to their nodes.
    tip_rotation, tip_spin : (3, 3), (3, 3K)
        The same for the end effector; identity and zeros where it has no frame.
    """

    def __init__(self, arm: Arm, *, compiled: bool) -> None:
        self._arm, self._compiled = arm, compiled
        self._kernel = self._function("arm", arm.stations).kernel(compiled=compiled)
        self.quantities, self._motion, tip_rotation, tip_spin, *stations = self._kernel.outputs
        members = 0 if arm.bays is None else arm.bays.member_count
        self.gradient = self._motion.reshape(members, -1, 3) if members else np.zeros((0, 0, 3))
        self.tip_rotation, self.tip_spin = tip_rotation.reshape(3, 3).T, tip_spin.reshape(-1, 3).T
        rotations, spins = stations or (np.zeros(0), np.zeros(0))
        self.station_rotation = rotations.reshape(-1, 3, 3).transpose(0, 2, 1)
        self.station_spin = spins.reshape(-1, 9, 3).transpose(0, 2, 1)

    def _function(self, name: str, stations: Stations | None) -> Bound:
        """Return q -> quantities, motion, the tip's rotation and spin, and the same of `stations` if there are any."""
        arm, constants = self._arm, Constants()
        symbols, tip = arm.symbols(constants), arm.end_effector
        q = ca.MX.sym("q", *symbols.shape)
        X = symbols.nodes(q)
        motion, _ = symbols.motion(q, q, ca.MX.zeros(*X.shape))
        outputs = [symbols.quantities(q), motion, ca.MX.eye(3), ca.MX.zeros(3, 3 * len(tip.nodes))]
        if tip.has_frame:
            outputs[2:] = tip_frames(arm, constants).at(X)
        if stations:
            at_home = arm.home[stations.nodes]
            outputs += Frames(at_home, stations.frames, stations.nodes, constants, "station").at(X)
        return constants.bound(name, [q], ca.cse(outputs))

    def evaluate(self, q: Array) -> None:
        """Overwrite every attribute with its value at the configuration `q`."""
        self._kernel.inputs[0][:] = q.reshape(-1)
        self._kernel()

    @cached_property
    def _without_stations(self) -> Kernel:
        kernel = self._function("arm_without_stations", None).kernel(compiled=self._compiled)
        for k in range(4):
            kernel.bind_output(k, self._kernel.outputs[k])
        return kernel

    @cached_property
    def _tip_alone(self) -> Kernel:
        kernel = tip_frame_function(self._arm).kernel(compiled=self._compiled)
        for k in range(2):
            kernel.bind_output(k, self._kernel.outputs[2 + k])
        return kernel

    def evaluate_tip(self, X: Array) -> None:
        """Overwrite rotation and spin of the tip alone, for nodes at `X` (N, 3), m."""
        tip = self._arm.end_effector
        if tip.has_frame:
            self._tip_alone.inputs[0][:] = X[tip.nodes].reshape(-1)
            self._tip_alone()

    def evaluate_quantities(self, q: Array) -> None:
        """Overwrite quantities, gradient and tip alone, at a quarter of the cost for a long arm."""
        kernel = self._kernel if len(self._arm.stations) <= _FEW_STATIONS else self._without_stations
        kernel.inputs[0][:] = q.reshape(-1)
        kernel()

    def motion(self) -> MotionRows:
        """Return how the nodes move at the configuration evaluated last."""
        return self._arm.motion_rows(self._motion.copy(), np.zeros(3 * len(self._arm.free)))


def tip_frame_function(arm: Arm) -> Bound:
    """Return the function from the tip's nodes (3, K) to its rotation (3, 3) and spin (3, 3K); the tip has a frame."""
    constants, tip = Constants(), arm.end_effector
    nodes = ca.MX.sym("nodes", 3, len(tip.nodes))
    frame = tip_frames(arm, constants, np.arange(len(tip.nodes)))
    return constants.bound("tip_frame", [nodes], list(frame.at(nodes)))


def tip_frames(arm: Arm, constants: Constants, columns: Index | None = None) -> Frames:
    """Return the end effector's frame, of positions of all nodes, or of those with its own nodes at `columns` (K,)."""
    tip = arm.end_effector
    among = tip.nodes if columns is None else columns
    return Frames(arm.home[tip.nodes][None], tip.frame[None], among[None], constants, "tip")


def between(start: Array, end: Array, pieces: int) -> Array:
    """Return (K + 1, ...) configurations at the ends of K equal `pieces` of a motion; its ends are exact."""
    shares = (np.arange(pieces + 1) / pieces).reshape(-1, *[1] * start.ndim)
    return np.asarray((1.0 - shares) * start + shares * end)


def rank(values: NDArray[Any], tolerance: float = RANK_TOLERANCE) -> int:
    """Return the rank of a Jacobian with these singular values."""
    return int(np.count_nonzero(values > tolerance * values.max(initial=0.0)))


def has_full_rank(rows: Array) -> bool:
    """Whether the rows of a Jacobian are independent."""
    return 0 < len(rows) <= rows.shape[1] and rank(np.linalg.svd(rows, compute_uv=False)) == len(rows)


def _or_none(limits: Array) -> list[float | None]:
    """Return limits as JSON data: None for infinity, which JSON lacks."""
    return [limit if math.isfinite(limit) else None for limit in limits.tolist()]
