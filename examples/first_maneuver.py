"""The first maneuver: solve a bundled problem, read its certificate, keep it and show it."""

import vgtm_qp as vq

problem = vq.load_problem("five_bay_two_cubes")
maneuver = vq.solve(problem)

print(f"{problem.name}: {maneuver.status} in {maneuver.steps} steps")
print(maneuver.certificate)

maneuver.save("first_maneuver.npz")
maneuver.plot(frames=4).savefig("first_maneuver.png", dpi=150)
maneuver.plot_clearance().savefig("first_maneuver_clearance.png", dpi=150)
vq.export_maneuver(maneuver, "first_maneuver.html")
print("open first_maneuver.html in a browser: it needs neither a server nor a network")
