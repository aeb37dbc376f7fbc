"""A row of one's own: no node of two faces comes further forward than a sheet of light that nobody may cross."""

import vgtm_qp as vq


def behind(sheet: float, face: str) -> vq.Inequality:
    """Return the row by which the nodes of a face stay behind a sheet at x = `sheet`, m."""

    def spare(nodes: dict) -> list:
        # Expressions of CasADi, each 0 or more in every state.
        return [sheet - nodes[f"{face}-{k}"][0] for k in (1, 2, 3)]

    return vq.Inequality(f"light before {face}", spare, unit="m")


problem = vq.load_problem("five_bay_free").replace({"maneuver.steps": 25})
for rows in ([], [behind(0.35, "n3")]):
    maneuver = vq.solve(problem, rows=rows)
    x = maneuver.nodes[:, 9:12, 0].max()
    print(f"{len(rows)} rows: {maneuver.status}, {maneuver.certificate.ok}; third face up to x = {x:.3f} m")
    for row in maneuver.manifest.get("own", {}).get("rows", ()):
        print(f"  {row['name']}: at least {row['least']:.6f} {row['unit']}")

resolver = vq.Resolver(problem, rows=[behind(1.4, "n5")])
for x in (0.4, 0.8, 1.2, 1.6):
    step = resolver.step(position=[x, 0.0, 4.1 - 0.5 * x], dt=5.0)
print(step, resolver.tip()[0].round(3))
