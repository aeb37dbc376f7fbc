"""The result of a maneuver as data: every accepted state, and the manifest of problem, arm and outcome."""

from __future__ import annotations

from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array
from vgtm_qp.errors import MissingExtraError, ResultError
from vgtm_qp.result.certificate import Certificate
from vgtm_qp.result.chain import RecordedChain
from vgtm_qp.result.file import check_arrays, frozen, names_of, plain, read_result, write_result
from vgtm_qp.result.manifest import WHOLE_PATH, check_manifest
from vgtm_qp.result.poses import base_poses

if TYPE_CHECKING:
    from pandas import DataFrame

_LEFT_OUT: Any = None
"""Default of the arrays that follow from the joints of a serial arm."""


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """Every accepted state of a maneuver; row 0 is the home pose. The arrays are read-only.

    Attributes
    ----------
    time : (T,)
        Seconds, increasing.
    control_vertices : (T, V, 3)
        Control vertices of the reference curve, m; V = 0 without a curve.
    tip_position, tip_rotation, tip_target_position : (T, 3), (T, 3, 3), (T, 3)
        Pose of the end effector, and the target for which each state was accepted, m.
    clearance, self_clearance : (T,)
        Least clearance at each state from obstacles, and between members that share no node, m, as the certificate
        defines it; infinite without any pair.
    progress : (T,)
        Share of the path covered, 0 to 1.
    step_time, phase_names, phase_time : (T,), (P,), (T, P)
        Computing time of each step and of its phases, s; 0 in row 0.
    manifest : dict
        Plain data, see `vgtm_qp.result.manifest`.
    tip_target_rotation, tip_target_pointing : (T, 3, 3) or None, (T, 3) or None
        Targets of orientation or direction, if these were tracked.
    nodes : (T, N, 3)
        Node positions, m. For a serial arm, whose file has none: base, joints and tip.
    members, member_names, member_actuated : (M, 2), (M,), (M,)
        The nodes, name and kind of each member; for a serial arm of each link.
    member_lengths : (T, M)
        m.
    joints, joint_names, body_names : (T, J), (J,), (B,), or None
        Of a serial arm: joint values, rad or m, and the names of joints and links.

    Raises
    ------
    ResultError
        An array has another shape or kind, or a wrong value; or the manifest is not strict JSON.
    """

    time: Array
    control_vertices: Array
    tip_position: Array
    tip_rotation: Array
    tip_target_position: Array
    clearance: Array
    self_clearance: Array
    progress: Array
    step_time: Array
    phase_names: NDArray[np.str_]
    phase_time: Array
    manifest: dict[str, Any]
    tip_target_rotation: Array | None = None
    tip_target_pointing: Array | None = None
    nodes: Array = _LEFT_OUT
    members: NDArray[np.int64] = _LEFT_OUT
    member_names: NDArray[np.str_] = _LEFT_OUT
    member_actuated: NDArray[np.bool_] = _LEFT_OUT
    member_lengths: Array = _LEFT_OUT
    joints: Array | None = None
    joint_names: NDArray[np.str_] | None = None
    body_names: NDArray[np.str_] | None = None

    def __post_init__(self) -> None:
        """Check shapes and kinds; freeze copies of the arrays."""
        manifest = check_manifest(self.manifest)
        object.__setattr__(self, "manifest", manifest)
        arrays = {name: plain(array) for name, array in self.arrays.items()}
        check_arrays(arrays)
        if self.joints is not None:
            arrays |= _links(RecordedChain(manifest["arm"]), self.configurations)
        for name, array in arrays.items():
            object.__setattr__(self, name, frozen(array))

    def __str__(self) -> str:
        """Return one paragraph: name, status, steps, cause of a stop, result of the verification."""
        text = f"{self._name}: {self.status}, {100.0 * self.reached:.4g} % of the path in {self.steps} steps."
        if way := self.manifest.get("way_out"):
            text += f" The problem as given was a dead end; this is the retry with {way}."
        if self.stopped_by:
            text += f" Stopped by {self.stopped_by}."
        certificate = self.certificate
        if certificate is None:
            return f"{text} Not verified yet."
        if certificate.ok:
            return f"{text} Verified."
        return f"{text} VERIFICATION FAILED: {'; '.join(certificate.failures()[:4])}."

    def __repr__(self) -> str:
        kind, share = type(self).__name__, 100.0 * self.reached
        return f"<{kind} {self._name!r}: {self.status}, {self.steps} steps, {share:.4g} %>"

    def _repr_html_(self) -> str:
        found = "" if self.certificate is None else self.certificate._repr_html_()
        return f"<p>{escape(str(self))}</p>{found}"

    def to_dataframe(self) -> DataFrame:
        """Return a table of pandas with a row a state, by time, s.

        Columns: the actuators' values, the positions of tip and target, m, and both least clearances, m.

        Raises
        ------
        MissingExtraError
            pandas is not installed.
        """
        try:
            from pandas import DataFrame, Index
        except ImportError:
            raise MissingExtraError("pandas", "pandas") from None
        places = {"tip": self.tip_position, "target": self.tip_target_position}
        columns = dict(zip(self.actuator_names, self.actuator_values.T, strict=True))
        columns |= {f"{name} {axis}": at[:, k] for name, at in places.items() for k, axis in enumerate("xyz")}
        columns |= {"clearance": self.clearance, "self clearance": self.self_clearance}
        return DataFrame(columns, index=Index(self.time, name="time"))

    @property
    def _name(self) -> str:
        return str(self.manifest["problem"].get("name", "unnamed"))

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of the result file by name, those that this maneuver has."""
        kind = () if self.joints is None else ("joints",)
        return {name: array for name in names_of(kind) if (array := getattr(self, name)) is not None}

    @property
    def configurations(self) -> Array:
        """(T, N, 3) nodes, m; of a serial arm (T, J + 6) joints, position and rotation vector of the base."""
        if self.joints is None:
            return self.nodes
        return np.concatenate([self.joints, base_poses(self.manifest["problem"], self.time)], axis=1)

    @property
    def actuator_names(self) -> tuple[str, ...]:
        """Actuated members, or joints of a serial arm."""
        names = self.member_names if self.joint_names is None else self.joint_names
        return tuple(names[self._actuated].tolist())

    @property
    def actuator_values(self) -> Array:
        """(T, n_a) lengths of the actuated members, m, or values of the joints, rad or m."""
        return (self.member_lengths if self.joints is None else self.joints)[:, self._actuated]

    @property
    def actuator_units(self) -> tuple[str, ...]:
        """``"m"`` or ``"rad"``."""
        turns = self.manifest["arm"].get("revolute", [False] * len(self._actuated))
        return tuple("rad" if turn else "m" for turn in np.asarray(turns)[self._actuated])

    @property
    def _actuated(self) -> NDArray[np.bool_]:
        if self.joints is None:
            return self.member_actuated
        return np.asarray(self.manifest["arm"]["actuated"], dtype=np.bool_)

    @property
    def status(self) -> str:
        """``"solved"``, ``"blocked"``, or ``"infeasible"``: at the end of the path, but with a fault."""
        return str(self.manifest["status"])

    @property
    def arrived(self) -> bool:
        """Whether the arm covered the whole path, with faults or without."""
        return self.reached >= WHOLE_PATH

    @property
    def reached(self) -> float:
        """Share of the path that the arm covered, 0 to 1."""
        return float(self.manifest["reached"])

    @property
    def blocked_by(self) -> tuple[str, ...]:
        """Names of all obstacles, members and limits that together stopped the arm."""
        return tuple(self.manifest["blocked_by"])

    @property
    def stopped_by(self) -> str:
        """What stopped the arm and what would let it go on, for people; empty if it was not stopped."""
        text: str = (self.manifest.get("stop") or {}).get("text", "")
        return text or ", ".join(self.blocked_by[:3])

    @property
    def remedies(self) -> list[list[dict[str, Any]]]:
        """Alternatives with which the arm gets past its stop: lists of changes of limits, as plain data."""
        return list((self.manifest.get("stop") or {}).get("remedies", []))

    @property
    def why_not(self) -> str:
        """Why the maneuver is not solved: what stopped the arm, or the first fault; empty if it is solved."""
        certificate = self.certificate
        return self.stopped_by or next(iter(() if certificate is None else certificate.failures()), "")

    @property
    def least_clearance(self) -> float | None:
        """Least clearance from obstacles over all states and between them, m; None without obstacles.

        Before verification it is that of the states alone. Pairs that began too near count here, although a
        certificate excuses them.
        """
        certificate = self.certificate
        between = None if certificate is None else certificate.clearance_between.value
        found = [float(self.clearance.min()), np.inf if between is None else between]
        return min(found) if min(found) < np.inf else None

    @property
    def steps(self) -> int:
        """Number of accepted steps."""
        return len(self.time) - 1

    @property
    def certificate(self) -> Certificate | None:
        """The result of the verification; None before it."""
        data = self.manifest.get("certificate")
        return None if data is None else Certificate.from_dict(data)

    def with_certificate(self, certificate: Certificate) -> Self:
        """Return this result with `certificate` in its manifest."""
        return replace(self, manifest={**self.manifest, "certificate": certificate.to_dict()})

    def summary(self, result: str | Path | None = None) -> dict[str, Any]:
        """Return what ``vgtm solve --json`` prints, as strict JSON data; `result` is the path of the file.

        Entries that come from the certificate are None before verification.
        """
        certificate, manifest = self.certificate, self.manifest

        def worst(name: str) -> float | None:
            return None if certificate is None else certificate.measures[name].value

        return {
            "name": manifest["problem"].get("name", ""),
            "status": self.status,
            "reached": self.reached,
            "steps": self.steps,
            "bays": manifest["arm"].get("bays"),
            "method": manifest.get("method"),
            "solver": manifest.get("solver"),
            "min_clearance": self.least_clearance,
            "min_clearance_between": None if certificate is None else self.least_clearance,
            "min_self_clearance": worst("self_clearance"),
            "max_member_error": worst("member_error"),
            "max_stroke_violation": worst("stroke_violation"),
            "max_rate_violation": worst("rate_violation"),
            "max_tip_error": worst("tip_error"),
            "max_tip_direction_error": worst("tip_direction_error"),
            "max_tracking_gap": worst("tracking_gap"),
            "states_off_curve": worst("states_off_curve"),
            "step_time": self._step_time(),
            "setup_time": manifest.get("setup_time"),
            "blocked_by": list(self.blocked_by),
            "stopped_by": self.stopped_by,
            "remedies": self.remedies,
            "clearance_rows": manifest.get("clearance_rows"),
            "way_out": str(manifest.get("way_out", "")),
            "verified": None if certificate is None else certificate.ok,
            "failures": [] if certificate is None else list(certificate.failures()),
            "notes": [] if certificate is None else list(certificate.notes),
            "result": None if result is None else str(result),
        }

    def _step_time(self) -> dict[str, Any]:
        """Median and percentiles of the steps, and median of each phase, s; without row 0, the home pose."""
        times = self.step_time[1:]
        if not len(times):
            return {"median": None, "p95": None, "p99": None, "phases": {}}
        median, p95, p99 = (float(value) for value in np.percentile(times, (50, 95, 99)))
        phases = np.median(self.phase_time[1:], axis=0)
        named = {str(name): float(value) for name, value in zip(self.phase_names, phases, strict=True)}
        return {"median": median, "p95": p95, "p99": p99, "phases": named}

    def save(self, path: str | Path) -> Path:
        """Write the result file and return its path; ResultError where it cannot be written.

        A process killed meanwhile leaves the old file or the new one.
        """
        write_result(Path(path), self.arrays, self.manifest)
        return Path(path)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a result file, without pickle, and check all of it.

        Raises
        ------
        ResultError
            There is no such file, it is cut or altered, of another version, or an array is missing or malformed.
        """
        arrays, manifest = read_result(Path(path))
        return cls(**arrays, manifest=manifest)


def _links(chain: RecordedChain, q: Array) -> dict[str, NDArray[Any]]:
    """Return points and links of a serial arm at configurations (T, J + 6), as nodes and members."""
    if q.shape[1] != len(chain.quantity_names) + 6:
        raise ResultError(
            f"array joints holds {q.shape[1] - 6} joints; manifest.arm describes {len(chain.quantity_names)}"
        )
    points = chain.nodes_at(q)
    return {
        "nodes": points,
        "members": chain.links,
        "member_names": np.array(chain.member_names),
        "member_actuated": chain.stretches,
        "member_lengths": chain.lengths(points),
    }
