"""A study of one's own: how far the arm can reach out between the cubes, and how sensitive it is there."""

import csv
from pathlib import Path

from matplotlib.figure import Figure

import vgtm_qp as vq

problem = vq.load_problem("five_bay_two_cubes").replace({"maneuver.steps": 25})

rows = []
for x in (1.2, 1.6, 2.0, 2.4):
    goal = {"time": 10.0, "position": [x, 0.0, 3.3]}
    maneuver = vq.solve(problem.replace({"maneuver.waypoint": [goal]}))
    sensitivity = maneuver.certificate.tip_error_per_millimetre.value
    rows.append((x, maneuver.status, maneuver.tip_position[-1, 0], sensitivity, maneuver.certificate.ok))
    print(
        f"asked for x = {x:.1f} m: {maneuver.status} at {maneuver.tip_position[-1, 0]:.3f} m, "
        f"{sensitivity:.1f} mm at the tip for 1 mm of actuator error, verified: {maneuver.certificate.ok}"
    )

out = Path("out")
out.mkdir(exist_ok=True)
with (out / "own_study.csv").open("w", newline="") as file:
    writer = csv.writer(file)
    writer.writerow(
        ["goal x [m]", "status", "reached x [m]", "tip error per mm of actuator error [mm]", "verified"]
    )
    writer.writerows(rows)

figure = Figure(figsize=(4.6, 2.7), layout="constrained")
axes = figure.add_subplot()
axes.plot([row[0] for row in rows], [row[2] for row in rows], marker="o")
axes.axline((rows[0][0], rows[0][0]), slope=1.0, color="0.7", linestyle="--", label="as asked")
axes.set(xlabel="goal x (m)", ylabel="reached x (m)")
axes.legend(frameon=False)
figure.savefig(out / "own_study.png", dpi=150)
