"""The same maneuver by the QP and by the two older methods: what each makes of the cubes."""

from pathlib import Path

import vgtm_qp as vq

problem = vq.load_problem("five_bay_two_cubes")
out = Path("out")
out.mkdir(exist_ok=True)

print(
    f"{'method':20s} {'status':10s} {'reached':>8s} {'clearance':>10s} {'beyond stroke':>14s} {'a step':>9s}"
)
for method in ("qp", "curve-pseudoinverse", "pseudoinverse"):
    maneuver = vq.solve(problem.replace({"method.name": method}))
    summary = maneuver.summary()
    print(
        f"{method:20s} {maneuver.status:10s} {100 * maneuver.reached:6.0f} % {summary['min_clearance']:8.3f} m"
        f" {summary['max_stroke_violation']:12.3f} m {1000 * summary['step_time']['median']:6.2f} ms"
    )
    maneuver.plot_clearance().savefig(out / f"clearance_{method}.png", dpi=150)
