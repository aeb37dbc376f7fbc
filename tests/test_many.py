"""Many maneuvers at once: over processes, and one resolver per thread."""

import threading

import numpy as np
import pytest

import vgtm_qp as vq


def quick(x):
    problem = vq.load_problem("five_bay_two_cubes")
    return problem.replace(
        {"maneuver.steps": 6, "maneuver.waypoint": [{"time": 2.0, "position": [x, 0.0, 4.0]}]}
    )


def test_processes_give_what_one_after_another_gives_in_order():
    problems = [quick(x) for x in (0.05, 0.1, 0.15)]
    together = list(vq.solve_many(problems, workers=2))
    for problem, maneuver in zip(problems, together, strict=True):
        alone = vq.solve(problem)
        assert maneuver.certificate.ok
        np.testing.assert_array_equal(maneuver.nodes, alone.nodes)


def test_a_wrong_problem_raises_at_its_turn():
    wrong = quick(0.1).replace({"maneuver.waypoint": [{"time": 2.0, "position": [50.0, 0.0, 4.0]}]})
    maneuvers = vq.solve_many([quick(0.05), wrong], workers=1, verify=False)
    assert next(maneuvers).status == "solved"
    with pytest.raises(vq.ProblemError, match="waypoint"):
        next(maneuvers)


def test_one_resolver_per_thread():
    """Threads that step at the same time do not touch each other's workspaces."""
    goals = [[0.02 * k, 0.01 * side * k, 4.06] for side in (-1, 1) for k in range(1, 9)]
    halves = goals[:8], goals[8:]

    def run(half):
        resolver = vq.Resolver(quick(0.1))
        return [resolver.step(position=goal).state.nodes for goal in half]

    alone = [run(half) for half in halves]
    found = [None, None]

    def work(k):
        found[k] = run(halves[k])

    threads = [threading.Thread(target=work, args=(k,)) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for nodes, wanted in zip(found, alone, strict=True):
        np.testing.assert_array_equal(nodes, wanted)
