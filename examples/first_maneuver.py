"""The first maneuver: solve a bundled problem, read its certificate, keep it and draw it."""

from pathlib import Path

import vgtm_qp as vq

problem = vq.load_problem("five_bay_two_cubes")
maneuver = vq.solve(problem)

print(f"{problem.name}: {maneuver.status} in {maneuver.steps} steps")
print(maneuver.certificate)

out = Path("out")
out.mkdir(exist_ok=True)
maneuver.save(out / "first_maneuver.npz")
maneuver.plot(frames=4).savefig(out / "first_maneuver.png", dpi=150)
maneuver.plot_clearance().savefig(out / "first_maneuver_clearance.png", dpi=150)
print("written: out/first_maneuver.npz and two figures")
print("as a page in three dimensions, with the extra [view]: vgtm export out/first_maneuver.npz --to html")
