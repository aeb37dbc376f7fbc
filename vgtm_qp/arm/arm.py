"""The door: all that a step may know of an arm.

An arm is a configuration q that places points in space, its *nodes* X = p(q) of shape (N, 3): the joints of a truss,
which are its configuration themselves, or the joints of a serial arm. *Bodies* are spanned by points of the arm,
*stations* are poses made of nodes: they track the reference curve, and the last of all is the end effector.

What moves an arm are its *quantities* [c; a]: those that are fixed, c(q) = const, and the actuated ones a(q), which
have boxes. They are as many as the coordinates of q, so that to first order the nodes move by K d_a + r.

Nothing outside the folder ``arm`` asks which arm it has.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.scatter import LengthScatter
from vgtm_qp.arm.symbols import Constants
from vgtm_qp.geometry.bodies import Bodies

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


class Label(NamedTuple):
    """Name, kind and unit of a row or column of the QP."""

    name: str
    kind: str
    unit: str


class Pose(NamedTuple):
    """Where the base is: its origin (3,), m, and rotation (3, 3) against its home pose."""

    position: Array
    rotation: Array

    def carry(self, points: Array, after: Pose) -> Array:
        """Return where `points` (K, 3), m, are if they move with the base from this pose to the one `after`."""
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
        What every `stride`-th station can keep on the curve exactly: ``"position"``, ``"pointing"``, ``"orientation"``.
    stride : int
    word : str
        What a station is called in names: ``"face"`` or ``"joint"``.
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
        """Return (F, 3) the positions of the stations where the nodes are at `X` (N, 3), m."""
        return np.asarray(np.einsum("fk,fkc->fc", self.weights, X.take(self.nodes, axis=0)))


@dataclass(frozen=True, eq=False)
class Tip:
    """The end effector: its nodes (K,), their weights (K,), and its rotation at home (3, 3).

    It has an orientation where it has three nodes or more.
    """

    nodes: Index
    weights: Array
    frame: Array

    @property
    def has_frame(self) -> bool:
        """Whether the end effector has an orientation."""
        return len(self.nodes) >= 3

    def position(self, X: Array) -> Array:
        """Return (3,) the position of the end effector, eq. (1), where the nodes are at `X` (N, 3), m."""
        return np.asarray(self.weights @ X.take(self.nodes, axis=0))


class Description(Protocol):
    """A dataclass of counts, whose text is for people."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __str__(self) -> str: ...


class MotionPattern(NamedTuple):
    """Where the nonzeros of the rows that tie nodes to actuators stand: rows and columns (E,), and the rows' labels.

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


class Kinematics(Protocol):
    """An arm at one configuration, in arrays that are overwritten by `evaluate`.

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

    quantities: Array
    gradient: Array
    station_rotation: Array
    station_spin: Array
    tip_rotation: Array
    tip_spin: Array

    def evaluate(self, q: Array) -> None:
        """Overwrite every attribute with its value at the configuration `q`."""
        ...

    def evaluate_quantities(self, q: Array) -> None:
        """Overwrite quantities and tip alone, at less cost."""
        ...

    def motion(self) -> MotionRows:
        """Return how the nodes move at the configuration evaluated last."""
        ...


class ArmSymbols(Protocol):
    """An arm in CasADi's symbols: functions of a configuration of :attr:`shape`.

    What is constant over a maneuver is an argument that is bound once, so that what is compiled depends on the
    topology of the arm alone.
    """

    shape: tuple[int, int]
    given: list[int]
    """Nodes whose displacement with the base is given; the others follow by the fixed quantities."""

    home: Any
    """(M, 1) the quantities at home."""

    can_eliminate: bool
    """Whether :meth:`response`, :meth:`closed` and :meth:`held` are there: coordinates follow one after another."""

    def nodes(self, q: Any) -> Any:
        """Return (3, N) the nodes."""
        ...

    def quantities(self, q: Any) -> Any:
        """Return (M, 1) the quantities."""
        ...

    def motion(self, q: Any, at: Any, moved: Any) -> list[Any]:
        """Return what :meth:`Arm.motion_rows` takes: rows at `at`, residuals at `q`, base moving by `moved` (3, N)."""
        ...

    def response(self, q: Any, at: Any, moved: Any) -> Any:
        """Return [K, r] (3 (N - N_c), n_a + 1) with K at `at` and r from the residuals at `q`."""
        ...

    def coordinates(self, nodes: Any, strokes: Any) -> Any:
        """Return which of both moves the configuration: those of the nodes (3 (N - N_c), c), or strokes (n_a, c)."""
        ...

    def along(self, q: Any, coordinates: Any) -> Any:
        """Return the configuration after a displacement of :meth:`coordinates` (c,)."""
        ...

    def closed(self, q: Any, lower: Any, upper: Any) -> Any:
        """Return the configuration after one Newton step to the fixed quantities, actuators in their boxes (n_a,)."""
        ...

    def error(self, quantities: Any, lower: Any, upper: Any) -> Any:
        """Return the norm of what quantities (M, 1) are off, boxes (n_a,) included."""
        ...

    def held(self, tracked: Sequence[int]) -> Callable[[Any, Any], Any] | None:
        """Return the Newton step of a configuration whose `tracked` stations go to points (3, K) of the curve.

        None where these and the fixed quantities do not determine the configuration, or not stage by stage.
        """
        ...


class LengthRowsLike(Protocol):
    """Rows of lengths: gradients (M, Q, 3) by the nodes each depends on, and right-hand sides (M,)."""

    gradient: Array
    rhs: Array


class Bays(Protocol):
    """The bays of an arm, for speed alone: how its members hang on one another.

    Attributes
    ----------
    node_count, member_count : int
    base, stage : (N,)
        Base nodes, and the stage in which each node is placed, -1 for those.
    free : (N - N_c,) int
    member_nodes : (M, Q) int
        Nodes that each member's length depends on.
    actuated, actuators : (M,) bool, (n_a,) int
    joints : object or None
        None for ideal pin joints.
    scatter : LengthScatter
    """

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


class Arm(Protocol):
    """What a step knows of an arm.

    Attributes
    ----------
    kind : str
        What the arm is called: the module of a truss, or ``"serial"``.
    node_names : tuple of str
        Length N.
    home_configuration : configuration
    home : (N, 3)
        Nodes at home, m.
    base : (N,) bool
        Nodes that only the base moves, eq. (7).
    free : (N - N_c,) int
        The others, eq. (9), in the order in which they can be eliminated.
    quantity_names : tuple of str
        Length M: fixed and actuated quantities.
    actuated : (M,) bool
    actuators : (n_a,) int
        Indices of the actuated quantities.
    actuator_units : (n_a,) str
        ``"m"`` or ``"rad"``.
    stroke, rate, acceleration : (M, 2), (M,), (M,)
        Least and greatest value, and greatest rates; inf where there is no limit.
    home_quantities : (M,)
    stations : Stations
        Empty where nothing tracks a curve.
    end_effector : Tip
    height : float
        Length of the axis from the base to the tip at home, m.
    motion_pattern : MotionPattern
    bays : Bays or None
        What the arm's own structure offers for speed.
    bodies : Bodies
        Spanned by the points of :meth:`points`.
    segments : int
        Number of bays or joints.
    leaves_chords : bool
        Whether points do not move on straight lines where the configuration does, see :meth:`deviation`.
    """

    kind: str

    @property
    def node_names(self) -> tuple[str, ...]: ...
    @property
    def home_configuration(self) -> Array: ...
    @property
    def home(self) -> Array: ...
    @property
    def base(self) -> Mask: ...
    @property
    def free(self) -> Index: ...
    @property
    def quantity_names(self) -> tuple[str, ...]: ...
    @property
    def actuated(self) -> Mask: ...
    @property
    def actuators(self) -> Index: ...
    @property
    def actuator_units(self) -> tuple[str, ...]: ...
    @property
    def stroke(self) -> Array: ...
    @property
    def rate(self) -> Array: ...
    @property
    def acceleration(self) -> Array: ...
    @property
    def home_quantities(self) -> Array: ...
    @property
    def stations(self) -> Stations: ...
    @property
    def end_effector(self) -> Tip: ...
    @property
    def height(self) -> float: ...
    @property
    def motion_pattern(self) -> MotionPattern: ...
    @property
    def bays(self) -> Bays | None: ...
    @property
    def bodies(self) -> Bodies: ...
    @property
    def segments(self) -> int: ...
    @property
    def leaves_chords(self) -> bool: ...

    def nodes(self, q: Array) -> Array:
        """Return (N, 3) the nodes at a configuration, m."""
        ...

    def measured(self, q: Array) -> Array:
        """Return (M,) the quantities by plain arithmetic, which shares nothing with :meth:`symbols` and kinematics."""
        ...

    def based(self, q: Array, pose: Pose) -> Array:
        """Return the configuration with its base at `pose` and all else as it is; eqs. (7)-(8)."""
        ...

    def carried(self, q: Array, before: Pose, after: Pose) -> Array:
        """Return the configuration that moves as a rigid body with its base from one pose to another."""
        ...

    def advanced(self, q: Array, nodes: Array, strokes: Array) -> Array:
        """Return the configuration after displacements of nodes (N, 3) and actuators (n_a,) that belong together."""
        ...

    def corrected(self, q: Array, missing: Array, solve: Callable[[], Array]) -> Array:
        """Return the configuration after one Newton step that changes the quantities by `missing` (M,).

        `solve` returns the displacements (N - N_c, 3) of the free nodes where they have to be solved for.
        """
        ...

    def kinematics(self, *, compiled: bool = True) -> Kinematics: ...

    def symbols(self, constants: Constants) -> ArmSymbols:
        """Return the arm in symbols, and add what it keeps constant to `constants`."""
        ...

    def points(self, q: Array) -> Array:
        """Return (P, 3) the points that span the bodies, m."""
        ...

    def deviation(self, start: Array, end: Array) -> float:
        """Return a bound of how much nearer two points come than their chords do, m, where q moves straight."""
        ...

    def reach(self) -> Array:
        """Return (N_c,) a bound of the distance from each base node to the tip in any pose, m."""
        ...

    def hollow(self) -> float:
        """Return a bound of the distance from the tip to the nearest point on the axis of a body, m."""
        ...

    def unreachable(self) -> tuple[str, ...]:
        """Return in words the tip motions that no actuator can start at home."""
        ...

    def over_nodes(self, q: Array, points: Index, coefficients: Array) -> tuple[Index, Array]:
        """Return nodes (R, S) and coefficients (R, S, 3) of rows over the displacements of points.

        Given are `points` (R, 4) and `coefficients` (R, 4, 3).
        """
        ...

    def travel(self, motion: Array) -> float:
        """Return a bound of how far a node's coordinate moves in a displacement of the configuration, m."""
        ...

    def describe(self) -> Description:
        """Return the arm's counts, and what they allow."""
        ...

    def record(self) -> dict[str, Any]:
        """Return what verification needs to know of the arm, as JSON data."""
        ...

    def recorded(self, q: Array, quantities: Array) -> dict[str, Any]:
        """Return the arrays of a result file that tell of configurations (T, ...) and quantities (T, M)."""
        ...

    def motion_rows(self, *values: Array) -> MotionRows:
        """Return the rows from the values of ``ArmSymbols.motion``."""
        ...
