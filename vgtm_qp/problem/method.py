"""``[method]``: how the redundancy is resolved, and the weights of the null-space terms."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal

from pydantic import Field

from vgtm_qp.problem.fields import Factor, Flag, Length, Name, Weight, quoted
from vgtm_qp.problem.table import Place, Table, shown

NullSpaceTerm = Literal[
    "node_rate",
    "actuator_rate",
    "stroke_centring",
    "curve_rate",
    "spacing",
    "smoothness",
    "obstacle_potential",
]
HardCoordinate = Literal["position", "pointing", "orientation"]
HARD_COORDINATES = ("position", "pointing", "orientation")
_KINDS = {
    "coupled": '"qp" with tracking "coupled"',
    "none": '"qp" with tracking "none"',
    "bays": '"qp" with tracking "recursive" or "parallel"',
    "pseudoinverse": '"pseudoinverse"',
    "curve-pseudoinverse": '"curve-pseudoinverse"',
}
"""Kinds of solution, as messages call them."""
_QP, _COUPLED, _INVERSE, _CURVE = (
    ("coupled", "bays", "none"),
    ("coupled", "bays"),
    ("pseudoinverse",),
    ("curve-pseudoinverse",),
)
SERVED: dict[str, tuple[str, ...]] = {
    "name": tuple(_KINDS),
    "tracking": (*_QP, *_CURVE),
    "tracking_mode": ("coupled",),
    "hard_coordinates": _COUPLED,
    "solver": ("coupled", "none"),
    "retries": tuple(_KINDS),
    "slow_approach": _QP,
    "step_limit": tuple(_KINDS),
    "variant": _INVERSE,
    "algebra": _INVERSE,
    "correct": (*_INVERSE, *_CURVE),
    "null_space": (*_INVERSE, *_CURVE),
    "damping": _INVERSE,
    "truncation": _INVERSE,
    "weights.node_rate": (*_QP, *_INVERSE),
    "weights.actuator_rate": (*_QP, *_INVERSE),
    "weights.stroke_centring": (*_QP, *_INVERSE),
    "weights.curve_rate": _COUPLED,
    "weights.tracking": ("coupled",),
    "weights.tangent": _COUPLED,
    "weights.roll": _COUPLED,
    "weights.spacing": _COUPLED,
    "weights.smoothness": _COUPLED,
    "weights.vertex_goal": _COUPLED,
    "weights.obstacle_potential": _INVERSE,
    "weights.end_effector": _QP,
    "weights.progress": _QP,
    "gains.spacing": _CURVE,
    "gains.smoothness": _CURVE,
    "gains.curve_rate": _CURVE,
    "gains.obstacle_potential": _CURVE,
}
"""The kinds of solution that use each key; with other kinds the key is refused unless it has its default."""
TRUSS_TERMS = ("node_rate", "actuator_rate", "stroke_centring", "obstacle_potential")
CURVE_TERMS = ("curve_rate", "spacing", "smoothness", "obstacle_potential")


class Weights(Table, called="[method.weights]"):
    """Weights of the terms of one step's QP; the terms are half squares of displacements over the step.

    In units, u is the mean length of members or links; times u, an angle is comparable with a length.
    """

    node_rate: Weight = Field(default=1.0, description="node displacements, m^2; unit 1")
    actuator_rate: Weight = Field(
        default=0.02, description="changes of actuators, m^2, or rad^2 times u^2; unit 1"
    )
    stroke_centring: Weight = Field(
        default=0.02,
        description="actuators after the step less their home values, m^2, or rad^2 times u^2; unit 1",
    )
    curve_rate: Weight = Field(default=0.02, description="displacements of the control vertices, m^2; unit 1")
    tracking: Weight = Field(
        default=0.1, description="gaps between faces and curve after the step, m^2; unit 1"
    )
    tangent: Weight = Field(
        default=0.05, description="angles between face normals and curve, rad^2; times u^2"
    )
    roll: Weight = Field(
        default=0.05, description="roll between faces and curve, rad^2, with torsion_vertices; times u^2"
    )
    spacing: Weight = Field(
        default=0.0, description="spacings of the curve nodes less those at home, m^2; unit 1"
    )
    smoothness: Weight = Field(
        default=0.001, description="second differences of the control vertices, m^2; unit 1"
    )
    vertex_goal: Weight = Field(
        default=1.0, description="gaps between control vertices and their goals, m^2; unit 1"
    )
    obstacle_potential: Weight = Field(
        default=0.0,
        description="potential of the obstacles within influence, for the pseudoinverse methods; times u^2",
    )
    end_effector: Weight = Field(
        default=1000.0,
        description="penalty on the tip's gap to its goal in mode elastic, m times u, or rad times u^2",
    )
    progress: Weight = Field(
        default=1000.0,
        description="share of a step's path that is given up in mode scaled, squared; times the square of its length",
    )

    @property
    def actuators(self) -> float:
        """Weight of the squared changes of actuators, by which they move and depart from home."""
        return self.actuator_rate + self.stroke_centring


class Gains(Table, called="[method.gains]"):
    """Gains of the null-space vector of eq. (38), where the curve is solved before the arm."""

    spacing: Weight = Field(
        default=1.0, description="spacings of the curve nodes less those of the stations at home, m^2; unit 1"
    )
    smoothness: Weight = Field(
        default=0.1, description="second differences of the control vertices less those at home, m^2; unit 1"
    )
    curve_rate: Weight = Field(
        default=1e-4, description="displacements of the control vertices in the null space, m^2; unit 1"
    )
    obstacle_potential: Weight = Field(
        default=1e-3, description="potential of the obstacles within influence; times u^2"
    )


class Method(Table, called="[method]"):
    """How each step is solved."""

    decisive = "name"

    name: Literal["qp", "pseudoinverse", "curve-pseudoinverse"] = Field(
        default="qp", description="the QP, eq. (28), or eqs. (37)-(39)"
    )
    tracking: Literal["coupled", "recursive", "parallel", "none"] = Field(
        default="coupled",
        description="arm and curve together; curve first, then segment after segment or all at once; no curve. The QP "
        "alone takes bays for segments, of trusses; with curve-pseudoinverse coupled means recursive",
    )
    tracking_mode: Literal["exact", "hard", "elastic"] = Field(
        default="exact",
        description="exact: faces are on the curve, except in steps of which that leaves less than a tenth, or less "
        "than half where they get a quarter further off it; there they stay as near as other rows let them; hard: in "
        "every step, or the arm stops; elastic: as near as the weights tracking and tangent draw them",
    )
    hard_coordinates: tuple[HardCoordinate, ...] = Field(
        default=("position",),
        min_length=1,
        description="what of each face is kept on the curve unless tracking is elastic: position; position and "
        "pointing; or position, pointing and orientation, as far as the bays of the module have the motions",
    )
    solver: Name = Field(default="daqp", description="daqp, osqp, piqp, or another solver of qpsolvers")
    retries: Flag = Field(
        default=True,
        description="whether other ways out of a dead end are tried before giving up; pseudoinverse methods know none",
    )
    slow_approach: Flag = Field(
        default=True,
        description="whether members slow down before they touch, and actuators before the ends of their strokes, so "
        "that rates do not jump; with mode scaled",
    )
    step_limit: Length | None = Field(
        default=None,
        description="greatest displacement of a node in one step, m; longer steps are shortened along the path, or "
        "refused where the tip stays on time",
    )
    variant: Literal["moore-penrose", "weighted", "damped", "truncated"] = Field(
        default="moore-penrose", description="pseudoinverse of eq. (28)"
    )
    algebra: Literal["dense", "sparse"] = Field(
        default="dense", description="how eq. (28) is solved: dense matrices, or a banded KKT system"
    )
    correct: Flag = Field(
        default=False,
        description="whether the pseudoinverse methods correct lengths and tip after each step by Newton's "
        "method; the paper does not",
    )
    null_space: tuple[NullSpaceTerm, ...] | None = Field(
        default=None,
        description="terms of the null-space vector of a pseudoinverse method; none if empty, and the usual "
        "ones of that method where absent",
    )
    damping: Factor = Field(default=0.01, description="damping of the variant damped")
    truncation: Factor = Field(
        default=0.001, description="singular values below this part of the greatest are zero when truncated"
    )
    weights: Weights = Field(default_factory=Weights, description="weights of the null-space terms")
    gains: Gains = Field(
        default_factory=Gains, description="gains of the curve's null-space vector, eq. (38)"
    )

    @property
    def modes(self) -> tuple[str, ...]:
        """Modes of the end effector that the method has; the pseudoinverse methods are always on time."""
        return ("scaled", "hard", "elastic") if self.name == "qp" else ("scaled", "hard")

    @property
    def goes_by_bays(self) -> bool:
        """Whether the QP is over the curve alone, and each bay follows the curve exactly."""
        return self.name == "qp" and self.tracking in ("recursive", "parallel")

    @property
    def holds_curve(self) -> bool:
        """Whether stations are kept on the curve by equalities."""
        is_held = self.tracking == "coupled" and self.tracking_mode != "elastic"
        return self.goes_by_bays or (self.name == "qp" and is_held)

    @property
    def gives_way(self) -> bool:
        """Whether stations may leave the curve if it holds the arm back; not with a solver by bays."""
        return self.holds_curve and self.tracking_mode == "exact" and not self.goes_by_bays

    @property
    def draws_vertices(self) -> bool:
        """Whether control vertices follow goals of their own."""
        return _kind(self.name, self.tracking) in _COUPLED

    @property
    def moves_curve_first(self) -> bool:
        """Whether the curve moves first, by itself, and the arm after it."""
        return self.name == "curve-pseudoinverse"

    def kept_by(self, name: str, tracking: str = "coupled") -> dict[str, Any]:
        """Return the table of another method, with those of its keys that differ from their defaults here."""
        kind = _kind(name, tracking)
        kept: dict[str, Any] = {"name": name, "tracking": tracking}
        for key, value in self._changed():
            outer, _, inner = key.partition(".")
            if kind in SERVED[key] and key not in kept:
                kept.setdefault(outer, {}).update({inner: value}) if inner else kept.update({key: value})
        return kept

    def _changed(self) -> Iterator[tuple[str, Any]]:
        """Yield each key that differs from its default, and its value; inner keys as ``weights.tracking``."""
        for key, value in self.model_dump(mode="json", exclude_defaults=True).items():
            if isinstance(value, Mapping):
                yield from ((f"{key}.{inner}", own) for inner, own in value.items())
            else:
                yield key, value

    def _unused(self) -> Iterator[tuple[Place, str]]:
        kind = _kind(self.name, self.tracking)
        for key, _ in self._changed():
            if kind not in SERVED[key]:
                others = " or ".join(_KINDS[other] for other in SERVED[key])
                place = tuple(key.split("."))
                table = type(self) if len(place) == 1 else type(getattr(self, place[0]))
                default = shown(table.model_fields[place[-1]].default)
                yield place, f"{default}, since {_KINDS[kind]} does without this key; it belongs to {others}"

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        kind = _kind(self.name, self.tracking)
        if self.name == "curve-pseudoinverse" and self.tracking == "none":
            yield ("tracking",), '"recursive" or "parallel": the method moves the curve first'
        if self.hard_coordinates != HARD_COORDINATES[: len(self.hard_coordinates)]:
            yield ("hard_coordinates",), f"the first one, two or three of {quoted(HARD_COORDINATES)}"
        if self.variant == "truncated" and self.algebra == "sparse":
            yield ("algebra",), '"dense", since the variant truncated needs the singular values'
        known = TRUSS_TERMS if kind == "pseudoinverse" else CURVE_TERMS
        for i, term in enumerate(self.null_space or () if kind in SERVED["null_space"] else ()):
            if term not in known:
                yield ("null_space", i), f"a term of the method {self.name}: {quoted(known)}"


def _kind(name: str, tracking: str) -> str:
    """Return the kind of solution of a method."""
    if name == "qp":
        return tracking if tracking in ("coupled", "none") else "bays"
    return name
