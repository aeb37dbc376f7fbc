"""What a control loop did, as a maneuver that can be verified, plotted and exported."""

from __future__ import annotations

from collections.abc import Sequence

from vgtm_qp.arm.arm import Pose
from vgtm_qp.errors import GoalError
from vgtm_qp.maneuver.log import Log
from vgtm_qp.maneuver.maneuver import Maneuver
from vgtm_qp.methods import Resolver
from vgtm_qp.problem import Problem
from vgtm_qp.rotation import vector_from_rotation
from vgtm_qp.step.step import Step


class Recording:
    """Records each step of a resolver from now on, and the scene that it was proven against.

    It keeps every state, so its memory grows with the loop; :meth:`stop` ends that.

    Parameters
    ----------
    resolver
        It may have moved, and its scene may have changed, before. It has one recording at a time: a new one ends the
        one before.
    problem
        The problem that it was made of.
    """

    def __init__(self, resolver: Resolver, problem: Problem) -> None:
        scene = {
            "obstacle": [table.model_dump(mode="json", exclude_none=True) for table in resolver.obstacles],
            "clearance.safe": resolver.setup.safe,
            "clearance.self_safe": resolver.setup.self_safe,
        }
        self._problem = problem.replace(scene) if resolver.scene_changes else problem
        self._resolver, self._targets = resolver, list[Pose]()
        self._log = Log(resolver, Pose(*resolver.tip()))
        resolver.listener = self._add

    def __len__(self) -> int:
        """Return the number of steps recorded so far."""
        return len(self._targets)

    def _add(self, target: Pose, step: Step) -> None:
        self._targets.append(target)
        self._log.count_phases()
        self._log.add(step, target, float(len(self._targets)))

    def stop(self) -> None:
        """Record no more steps."""
        if self._resolver.listener == self._add:
            self._resolver.listener = None

    def maneuver(self) -> Maneuver:
        """Return the steps so far as a maneuver along the poses that were asked of the tip; not certified yet.

        Its problem has these poses as waypoints. Where the scene changed, the manifest has each scene and the row from
        which on it counts; `verify` checks each step against its own.

        Raises
        ------
        GoalError
            No step has moved the arm yet.
        """
        if not self._targets:
            raise GoalError("nothing is recorded yet: no step has moved the arm")
        return self._log.maneuver(problem_along(self._problem, self._targets), whole=len(self._targets))


def problem_along(problem: Problem, targets: Sequence[Pose]) -> Problem:
    """Return the problem with the path of a loop through `targets`, which is known only after it."""
    track = problem.to_dict()["end_effector"]["track"]
    waypoints = [
        {
            "time": float(k + 1),
            "position": target.position.tolist(),
            **({"pointing": target.rotation[:, 2].tolist()} if "pointing" in track else {}),
            **(
                {"rotation_vector": vector_from_rotation(target.rotation).tolist()}
                if "orientation" in track
                else {}
            ),
        }
        for k, target in enumerate(targets)
    ]
    return problem.replace({"maneuver": {"steps": len(targets), "waypoint": waypoints}})
