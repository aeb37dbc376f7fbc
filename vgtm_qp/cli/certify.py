"""``vgtm certify``: a proof for anybody's trajectory."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from vgtm_qp.cli.output import ExitCode, Json, ProblemName, answer, waiting


def certify(
    problem: ProblemName,
    trajectory: Annotated[
        Path,
        Parameter(
            name="TRAJECTORY",
            help="CSV file: t and the names of joints or actuators; or a ROS 2 bag, or a JointTrajectory in YAML",
        ),
    ],
    /,
    *,
    json: Json = False,
) -> int:
    """Prove or refute a trajectory for a problem's arm and obstacles, over the whole time and not at its rows alone.

    Joints and actuators move linearly between the rows. Exit code 0 means that limits, rates, accelerations
    and clearances are proven; 4 that one is violated or cannot be decided.
    """
    from vgtm_qp.certify.certify import Certifier
    from vgtm_qp.problem import load_problem

    with waiting(f"{trajectory.name}: certifying", shown=not json):
        verdict = Certifier(load_problem(problem)).certify_file(trajectory)
    found = {"trajectory": str(trajectory), **verdict.to_dict()}
    answer(found, f"{trajectory}: {verdict}", as_json=json)
    return ExitCode.SOLVED if verdict.certified else ExitCode.UNVERIFIED
