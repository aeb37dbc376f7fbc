"""A truss module of one's own: a platform on six legs, which is stacked as often as `bays` says."""

import numpy as np

import vgtm_qp as vq


def towers(*, bays: int, height: float = 0.9, radius: float = 0.6, taper: float = 0.9) -> dict:
    """Return nodes, members, tip and faces as in a [[truss.node]] table and so on; m."""
    nodes, members, faces = [], [], []
    for layer in range(bays + 1):
        angles = (layer % 2) * np.pi / 3.0 + 2.0 * np.pi * np.arange(3) / 3.0
        width = radius * taper**layer
        points = np.column_stack([width * np.cos(angles), width * np.sin(angles), np.full(3, layer * height)])
        faces.append([f"n{layer}-{k}" for k in range(3)])
        nodes += [{"name": faces[-1][k], "position": points[k], "fixed": layer == 0} for k in range(3)]
        for k in range(3) if layer else ():
            members.append({"name": f"edge{layer}-{k}", "nodes": [faces[-1][k], faces[-1][(k + 1) % 3]]})
            for j in (k, (k + 1) % 3) if layer % 2 else (k, (k + 2) % 3):
                leg = {"name": f"leg{layer}-{k}-{j}", "nodes": [faces[-1][k], faces[-2][j]]}
                members.append({**leg, "actuated": True, "stroke": [0.7 * height, 1.6 * height]})
    return {"node": nodes, "member": members, "tip": faces[-1], "faces": faces}


vq.register("module", "towers", towers)
problem = vq.load_problem("five_bay_free").replace({"truss": {"module": "towers", "bays": 4, "taper": 0.8}})
maneuver = vq.solve(problem.replace({"maneuver.waypoint": [{"time": 10.0, "position": [0.5, 0.2, 3.4]}]}))
print(f"{len(maneuver.member_names)} members; {maneuver.status}; verified: {maneuver.certificate.ok}")
