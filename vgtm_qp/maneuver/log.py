"""The rows of a result, grown state by state, and the maneuver that they make."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from vgtm_qp.arm.arm import Pose
from vgtm_qp.errors import GoalError
from vgtm_qp.maneuver.maneuver import Maneuver
from vgtm_qp.methods import Resolver
from vgtm_qp.problem import Problem
from vgtm_qp.qp.layout import curve_record
from vgtm_qp.result.manifest import SCHEMA_VERSION, mesh_record, recorded_versions
from vgtm_qp.step.state import State
from vgtm_qp.step.step import Step
from vgtm_qp.step.stops import Stop


class Log:
    """The states of a resolver from now on, each with the pose asked of its tip.

    Attributes
    ----------
    progress : float
        Share of the path covered at the last state, 0 to 1.
    """

    def __init__(self, resolver: Resolver, target: Pose) -> None:
        self.progress = 0.0
        self._resolver = resolver
        self._rows: dict[str, list[Any]] = {}
        self._scenes = [_RecordedScene(resolver, 0, resolver.state)]
        # The problem has nothing that is carried.
        self._begins_otherwise = bool(self._scenes[0].carried)
        self._changes, self._state = resolver.scene_changes, resolver.state
        self._clearance_rows = {"fcl": 0, "exact": 0}
        self._seconds, self._phases = 0.0, [0.0] * len(resolver.phases)
        self._known = dict(resolver.phases)
        self._add_row(target)

    def count_phases(self) -> None:
        """Take the phases since the last call, or since the beginning, for the time of the next row's step."""
        known, self._known = self._known, dict(self._resolver.phases)
        self._phases = [total - known[name] for name, total in self._known.items()]
        self._seconds = sum(self._phases)

    @contextmanager
    def clock(self) -> Iterator[None]:
        """Record the time of the step in this context, as a whole and by phase."""
        resolver = self._resolver
        known, started = dict(resolver.phases), perf_counter()
        yield
        self._seconds = perf_counter() - started
        self._phases = [total - known[name] for name, total in resolver.phases.items()]

    def add(self, step: Step, target: Pose, progress: float) -> None:
        """Add the state after a step whose goal was the pose `target` of the tip."""
        if self._resolver.scene_changes != self._changes:
            self._change(len(self._rows["time"]) - 1)
        self._state = step.state
        self._clearance_rows["fcl"] += step.fcl_rows
        self._clearance_rows["exact"] += step.exact_rows
        self.progress = progress
        self._add_row(target)

    def _change(self, row: int) -> None:
        """Take the scene of now for that from a row on; before the first step, for that of the beginning."""
        self._changes, scene = self._resolver.scene_changes, _RecordedScene(self._resolver, row, self._state)
        if row:
            self._scenes.append(scene)
            return
        self._scenes, self._begins_otherwise = [scene], True
        for name, value in self._clearances(self._state).items():
            self._rows[name] = [value]

    def _clearances(self, state: State) -> dict[str, float]:
        """Return the least clearances of a state in the scene of now, m."""
        measured = self._resolver.setup.least_clearance
        return {
            "clearance": measured(state.q, state.time, "obstacles"),
            "self_clearance": measured(state.q, state.time, "members"),
        }

    def _add_row(self, target: Pose) -> None:
        resolver, state = self._resolver, self._resolver.state
        position, rotation = resolver.tip()
        row = {
            "time": state.time,
            "configuration": state.q,
            "quantities": state.quantities,
            "control_vertices": state.control_vertices,
            "tip_position": position,
            "tip_rotation": rotation,
            "tip_target_position": target.position,
            "tip_target_rotation": target.rotation,
            **self._clearances(state),
            "progress": self.progress,
            "step_time": self._seconds,
            "phase_time": self._phases,
        }
        for name, value in row.items():
            self._rows.setdefault(name, []).append(value)

    def maneuver(
        self, problem: Problem, stop: Stop | None = None, *, whole: float = 1.0, **entries: Any
    ) -> Maneuver:
        """Return the rows as the maneuver of a problem, not certified yet.

        `whole` is the progress at the end of the path. `entries` are added to the manifest, see ``result.manifest``:
        digests of the problem's files, the retry that led out of a dead end, and the time of the set-up.
        """
        resolver, setup, first = self._resolver, self._resolver.setup, self._scenes[0]
        scenes = self._scenes if self._begins_otherwise else self._scenes[1:]
        if len({np.shape(vertices) for vertices in self._rows["control_vertices"]}) > 1:
            raise GoalError(
                "the number of control vertices changed while it was recorded; record again from there"
            )
        own = setup.layout.own
        manifest = {
            "schema_version": SCHEMA_VERSION,
            "problem": problem.to_dict(),
            "arm": setup.arm.record(),
            "curve": curve_record(setup.layout),
            "status": "solved" if stop is None else "blocked",
            # From the last whole row: an interrupt may have come before the next one.
            "reached": float(self._rows["progress"][-1]) / whole,
            "blocked_by": [] if stop is None else list(stop.names),
            "stop": None if stop is None else stop.to_dict(),
            "recovered": [] if self._begins_otherwise else first.recovered,
            "method": problem.method.name,
            "solver": resolver.solver,
            "directory": str((problem.source.parent if problem.source else Path.cwd()).resolve()),
            "meshes": first.meshes,
            **({"scenes": [scene.record() for scene in scenes]} if scenes else {}),
            "versions": recorded_versions(),
            "certificate": None,
            # Of the Jacobian of eq. (26) in the last step, where the method reveals it: eq. (6) holds at full row rank.
            "jacobian_rank": resolver.rank,
            "clearance_rows": self._clearance_rows,
            **({"own": own.record(np.asarray(self._rows["configuration"]))} if own else {}),
            **entries,
        }
        arrays: dict[str, Any] = {name: np.asarray(rows, dtype=float) for name, rows in self._rows.items()}
        arrays["progress"] /= whole
        rotation = arrays.pop("tip_target_rotation")
        arrays |= setup.arm.recorded(arrays.pop("configuration"), arrays.pop("quantities"))
        arrays["control_vertices"] = arrays["control_vertices"].reshape(len(rotation), -1, 3)
        return Maneuver(
            **arrays,
            phase_names=np.array(list(resolver.phases)),
            manifest=manifest,
            tip_target_rotation=rotation if setup.task.turns == "orientation" else None,
            tip_target_pointing=rotation[:, :, 2] if setup.task.turns == "pointing" else None,
        )


class _RecordedScene:
    """The scene of a resolver from a row on, at which it was in a `state`.

    Attributes
    ----------
    recovered : list of dict
        Pairs that are too near in that state and that the method drives apart, with distances, m.
    carried : list of dict
        Records of what the arm carries.
    """

    def __init__(self, resolver: Resolver, row: int, state: State) -> None:
        setup = resolver.setup
        self._row, self._obstacles = row, setup.monitor.obstacles
        self._safe, self._self_safe = setup.safe, setup.self_safe
        self.carried = [body.record() for body in setup.carrier.carried]
        self._held = [body.obstacle for body in setup.carrier.carried]
        found: dict[str, float] = {}
        for pair, distance in resolver.too_near(state).items():
            name = setup.monitor.names.plain(pair)
            found[name] = min(found.get(name, np.inf), distance)
        self.recovered = [{"pair": pair, "distance": apart} for pair, apart in sorted(found.items())]

    @property
    def meshes(self) -> dict[str, Any]:
        """Records of the files of meshes, by name; a file that is gone has none."""
        return {
            obstacle.name: mesh_record(obstacle.table.file, len(obstacle.pieces))
            for obstacle in (*self._obstacles, *self._held)
            if obstacle.table.shape == "mesh" and Path(obstacle.table.file).is_file()
        }

    def record(self) -> dict[str, Any]:
        """Return the scene as the manifest has it."""
        return {
            "row": self._row,
            "obstacle": [o.table.model_dump(mode="json", exclude_none=True) for o in self._obstacles],
            "safe": self._safe,
            "self_safe": self._self_safe,
            "meshes": self.meshes,
            "recovered": self.recovered,
            **({"carried": self.carried} if self.carried else {}),
        }
