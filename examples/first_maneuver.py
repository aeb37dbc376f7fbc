"""The first maneuver: solve a bundled problem, read its certificate, keep it and draw it."""

import vgtm_qp as vq

problem = vq.load_problem("five_bay_two_cubes")
maneuver = vq.solve(problem)

print(f"{problem.name}: {maneuver.status} in {maneuver.steps} steps")
print(maneuver.certificate)

maneuver.save("first_maneuver.npz")
maneuver.plot(frames=4).savefig("first_maneuver.png", dpi=150)
maneuver.plot_clearance().savefig("first_maneuver_clearance.png", dpi=150)
print("written: first_maneuver.npz and two figures")
print("as a page in three dimensions, with the extra [view]: vgtm export first_maneuver.npz --to html")
