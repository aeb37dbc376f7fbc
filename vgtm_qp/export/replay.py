"""Replays a maneuver in MuJoCo, exactly and under gravity, and compares it with the certificate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import ExportError, MissingExtraError
from vgtm_qp.export.mjcf import ACTUATOR_GROUP, mjcf, modelled_arm
from vgtm_qp.result.result import Result
from vgtm_qp.verify.clearance import AgainstBody, RecordedMotion
from vgtm_qp.verify.obstacles import read_obstacles

_SETTLING_STEPS = 200
_PROBED_TIP_MOTION = 1e-4
_PROBED_STATES = 51


@dataclass(frozen=True, eq=False)
class ReplayRun:
    """How a replay followed a maneuver. All but `contacts` are (T,), one a state: m; of joints rad or m."""

    length_error: Array
    """Greatest error of a member's length, or of a joint's value."""
    tip_error: Array
    """Distance of the tip from where it should be."""
    actuator_error: Array
    """Root of the summed squares of the errors of the actuated ones."""
    clearance: Array
    """Least distance from members or links to obstacles at the states; inf without obstacles."""
    contacts: int
    """Time steps in which MuJoCo found a node or link in contact with an obstacle."""

    def to_dict(self) -> dict[str, Any]:
        """Return the worst values as strict JSON data, m; None if there are no obstacles."""
        clearance = float(self.clearance.min())
        return {
            "max_length_error": float(self.length_error.max()),
            "max_tip_error": float(self.tip_error.max()),
            "last_tip_error": float(self.tip_error[-1]),
            "max_actuator_error": float(self.actuator_error.max()),
            "min_clearance": clearance if np.isfinite(clearance) else None,
            "contacts": self.contacts,
        }


@dataclass(frozen=True, eq=False)
class Replay:
    """A kinematic and a physical replay of one maneuver."""

    kinematic: ReplayRun
    physics: ReplayRun
    tip_error_per_millimetre: float
    """mm at the tip for actuator errors whose squares sum to 1 mm^2, found by pushing each actuator."""
    probed_state: int
    """The state at which that was measured: the one where the Jacobian predicts the greatest value."""
    certified_tip_error_per_millimetre: float
    """The same from the Jacobian, as in the certificate."""
    of_joints: bool = False
    """Whether actuators are joints: mm at the tip are then for errors of 1 mrad or 1 mm."""

    def rows(self) -> list[tuple[str, str, str, str]]:
        """Return the table: quantity, certificate, kinematic replay, physics replay."""
        exact, real = self.kinematic.to_dict(), self.physics.to_dict()
        expected = self.certified_tip_error_per_millimetre * self.physics.actuator_error
        what, unit, body = ("joint", "mrad or mm", "link") if self.of_joints else ("length", "mm", "node")
        lengths = (
            (f"greatest {what} error [{unit}]", "0", "max_length_error"),
            ("greatest tip error [mm]", f"at most {_mm(expected.max())}", "max_tip_error"),
            ("tip error at the end [mm]", f"at most {_mm(expected[-1])}", "last_tip_error"),
            ("least clearance [mm]", "-", "min_clearance"),
        )
        measured, certified = self.tip_error_per_millimetre, self.certified_tip_error_per_millimetre
        return [
            *((name, wanted, _mm(exact[key]), _mm(real[key])) for name, wanted, key in lengths),
            (f"steps with a {body} in contact", "0", str(exact["contacts"]), str(real["contacts"])),
            (f"tip error per {unit} of actuator error [mm]", f"{certified:.4g}", "-", f"{measured:.4g}"),
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return all of it as strict JSON data; lengths in m."""
        runs = {"kinematic": self.kinematic.to_dict(), "physics": self.physics.to_dict()}
        return {**vars(self), **runs}


def replay(maneuver: Result) -> Replay:
    """Replay a maneuver in MuJoCo, as it was solved and under gravity.

    The physics replay drives the length of every member, or the value of every joint, through equality constraints, in
    straight lines between the states; gravity pulls. Joints have the masses of the problem, if it gives any; otherwise
    members and links have `vgtm_qp.export.mjcf.MASS_PER_LENGTH`.

    Raises
    ------
    MissingExtraError
        MuJoCo is not installed.
    ExportError
        As ``mjcf``.
    """
    simulation = _Simulation(maneuver)
    kinematic, physics = (simulation.recorded(move) for move in (simulation.place, simulation.drive))
    state, certified = simulation.most_sensitive_state()
    measured, of_joints = simulation.measured_sensitivity(state, certified), maneuver.joints is not None
    return Replay(kinematic, physics, measured, state, certified, of_joints)


class _Simulation:
    """The MuJoCo model of one maneuver, its data, and the places of the maneuver's parts in them."""

    def __init__(self, maneuver: Result) -> None:
        try:
            import mujoco
        except ModuleNotFoundError:
            raise MissingExtraError("mujoco", "mujoco") from None
        except ImportError as error:
            raise ExportError(f"MuJoCo cannot be loaded: {error}; vgtm doctor says what to do") from None
        self._mujoco, self._maneuver = mujoco, maneuver
        self._arm = modelled_arm(maneuver)
        try:
            self._model: Any = mujoco.MjModel.from_xml_string(mjcf(maneuver))
        except ValueError as error:
            raise ExportError(f"MuJoCo takes no such model: {str(error).splitlines()[0]}") from None
        self._data: Any = mujoco.MjData(self._model)
        manifest = maneuver.manifest
        directory = Path(manifest.get("directory") or ".")
        self._bodies = read_obstacles(manifest["problem"], manifest.get("meshes") or {}, directory)[0]
        count = len(maneuver.time)
        self._wanted = maneuver.member_lengths if maneuver.joints is None else maneuver.joints
        # The model's equality constraints hold its home pose; those of tendons count from there.
        moved = self._arm.of_values(self._wanted) - self._arm.home_quantities
        self._held = moved + self._model.eq_data[:, 0]
        self._mocap = np.array(self._model.key_mpos).reshape(count, -1, 3)
        self._turned = np.array(self._model.key_mquat).reshape(count, -1, 4)

    def recorded(self, move: Callable[[int], int]) -> ReplayRun:
        """Return how the arm followed; `move` takes it to a state and returns its time steps in contact."""
        maneuver, arm = self._maneuver, self._arm
        states, values = np.array(maneuver.configurations), np.empty_like(self._wanted)
        tips, contacts = np.empty_like(maneuver.tip_position), 0
        for k in range(len(states)):
            contacts += move(k)
            tips[k] = self._tip_now()
            if maneuver.joints is None:
                values[k], states[k] = self._data.ten_length, self._data.site_xpos
            else:
                # The base is where the problem moves it.
                values[k] = states[k, : values.shape[1]] = self._data.qpos
        errors = values - self._wanted
        motion = RecordedMotion(arm, maneuver.time, states)
        each = [AgainstBody(motion, body).at_states() for body in self._bodies]
        least = [min((found[k].value for found in each), default=np.inf) for k in range(len(states))]
        return ReplayRun(
            length_error=np.abs(errors).max(axis=1),
            tip_error=np.linalg.norm(tips - maneuver.tip_position, axis=1),
            actuator_error=np.linalg.norm(errors[:, arm.actuated], axis=1),
            clearance=np.array(least),
            contacts=contacts,
        )

    def place(self, state: int) -> int:
        """Put the arm exactly into a state."""
        self._mujoco.mj_resetDataKeyframe(self._model, self._data, state)
        self._mujoco.mj_forward(self._model, self._data)
        return int(self._data.ncon > 0)

    def drive(self, state: int) -> int:
        """Simulate the motion to a state: under gravity, with lengths or joints as moving constraints."""
        if state == 0:
            self._hold(0)
            self._settle()
            return 0
        contacts, time = 0, self._maneuver.time
        steps = max(1, round(float(time[state] - time[state - 1]) / self._model.opt.timestep))
        for share in np.arange(1, steps + 1) / steps:
            self._command(state - 1, float(share))
            self._mujoco.mj_step(self._model, self._data)
            contacts += self._data.ncon > 0
        self._mujoco.mj_fwdPosition(self._model, self._data)
        return contacts

    def most_sensitive_state(self) -> tuple[int, float]:
        """Return the state where actuator errors move the tip most, and how far by the Jacobian, mm/mm."""
        states = np.unique(np.linspace(0, len(self._mocap) - 1, _PROBED_STATES).round().astype(int))
        values = [
            found[2] if (found := self._arm.singular_values(self._maneuver.configurations[k])) else 0.0
            for k in states
        ]
        worst = int(np.argmax(values))
        return int(states[worst]), float(values[worst])

    def measured_sensitivity(self, state: int, expected: float) -> float:
        """Return that displacement as measured, by moving one actuator after another and waiting for the tip.

        Gravity is off: sag would take a nearly singular pose away from its singularity. Each actuator moves
        so little that the tip should move by a tenth of a millimetre: near a singularity it soon moves less
        than in proportion.
        """
        data, probe = self._data, _PROBED_TIP_MOTION / max(expected, 1.0)
        gravity = self._model.opt.gravity.copy()
        self._model.opt.gravity[:] = 0.0
        self._hold(state)
        self._settle()
        start, velocity, before = data.qpos.copy(), data.qvel.copy(), self._tip_now()
        targets = self._model.eq_data[:, 0].copy()
        moved = []
        for k in np.flatnonzero(self._arm.actuated):
            data.qpos[:], data.qvel[:] = start, velocity
            self._model.eq_data[k, 0] = targets[k] + probe
            self._settle()
            moved.append((self._tip_now() - before) / probe)
            self._model.eq_data[k, 0] = targets[k]
        self._model.opt.gravity[:] = gravity
        return float(np.linalg.norm(np.array(moved), ord=2)) if moved else 0.0

    def _hold(self, state: int) -> None:
        """Put the arm at rest in a state, with a constraint on every length or joint."""
        self._mujoco.mj_resetDataKeyframe(self._model, self._data, state)
        self._model.opt.disableactuator |= 1 << ACTUATOR_GROUP
        self._data.eq_active[:] = 1
        self._command(state, 0.0)

    def _command(self, state: int, share: float) -> None:
        """Set lengths or joints, base and obstacles to a `share` of the motion from `state` to the next."""
        after = min(state + 1, len(self._mocap) - 1)
        self._model.eq_data[:, 0] = (1.0 - share) * self._held[state] + share * self._held[after]
        self._data.mocap_pos[:] = (1.0 - share) * self._mocap[state] + share * self._mocap[after]
        # MuJoCo normalises quaternions.
        self._data.mocap_quat[:] = (1.0 - share) * self._turned[state] + share * self._turned[after]

    def _settle(self) -> None:
        for _ in range(_SETTLING_STEPS):
            self._mujoco.mj_step(self._model, self._data)
        self._mujoco.mj_fwdPosition(self._model, self._data)

    def _tip_now(self) -> Array:
        if self._maneuver.joints is None:
            return self._arm.tip_position(np.asarray(self._data.site_xpos))
        return np.array(self._data.site("tip").xpos)


def _mm(metres: float | None) -> str:
    return f"{1000.0 * metres:.4g}" if metres is not None else "inf"
