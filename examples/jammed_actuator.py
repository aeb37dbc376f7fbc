"""An actuator jams on the way: the arm goes on with those that are left."""

from pathlib import Path

import numpy as np

import vgtm_qp as vq

problem = vq.load_problem("five_bay_two_cubes")
jammed = problem.replace({"truss.locked": [{"member": "B3-1", "time": 4.0}]})

healthy, hurt = vq.solve(problem), vq.solve(jammed)
column = list(hurt.member_names).index("B3-1")
after = hurt.time >= 4.0

print(f"healthy: {healthy.status}, B3-1 ends at {healthy.member_lengths[-1, column]:.4f} m")
print(f"jammed:  {hurt.status}, B3-1 stays at {hurt.member_lengths[-1, column]:.4f} m")
moved = np.ptp(hurt.member_lengths[after, column])
print(f"it moved by {moved:.9f} m after it had jammed")
print(f"verified: {hurt.certificate.ok}; clearance {hurt.clearance.min():.4f} m")
if hurt.status != "solved":
    print("stopped by", hurt.stopped_by)

out = Path("out")
out.mkdir(exist_ok=True)
hurt.plot_strokes().savefig(out / "jammed_actuator.png", dpi=150)
