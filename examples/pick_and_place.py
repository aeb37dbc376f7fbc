"""Pick and place: the arm takes up a crate, carries it to the other side and lets it go; all of it is certified."""

from pathlib import Path

import numpy as np

import vgtm_qp as vq

OUT = Path("out")
OUT.mkdir(exist_ok=True)

problem = vq.load_problem("five_bay_two_cubes")
resolver = vq.Resolver(problem)
recording = vq.Recording(resolver, problem)
home = resolver.tip()[0]
resolver.add_obstacle(vq.Box(name="crate", center=np.add(home, [-0.75, 0.0, 0.25]), size=[0.3, 0.3, 0.25]))


def go(shift: list[float], steps: int = 12) -> None:
    """Step along the straight way to a place beside home, as far as the arm can."""
    goal, start = np.add(home, shift), resolver.tip()[0]
    for share in np.linspace(0.0, 1.0, steps + 1)[1:]:
        step = resolver.step(position=start + share * (goal - start), dt=0.2)
    if step.status is not vq.StepStatus.REACHED:
        gap = np.linalg.norm(goal - resolver.tip()[0])
        print(f"held {gap:.3f} m from its goal by {', '.join(step.blocked_by[:2])}")


# Beside the crate a gripper takes it: from now on it belongs to the arm, and keeps clear of the cubes like a member.
go([-0.25, 0.0, -0.05])
print(f"taken up, too near: {resolver.attach('crate') or 'nothing'}")
go([0.2, 0.0, 0.1])
go([1.4, 0.0, -0.7], steps=20)
place = np.array(resolver.carried[0].center)
print(f"let go at {place.round(2).tolist()}, too near: {resolver.release('crate') or 'nothing'}")
go([0.6, 0.0, -0.1])

maneuver = recording.maneuver()
certificate = vq.verify(maneuver)
print(f"{len(maneuver.time) - 1} steps, certified: {certificate.ok}; {certificate.notes[-1]}")
print(f"least clearance {certificate.clearance_between.value:.4f} m: {certificate.clearance_between.where}")
maneuver.plot(frames=6).savefig(OUT / "pick_and_place.png", dpi=150)
