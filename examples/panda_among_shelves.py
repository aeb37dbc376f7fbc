"""A Panda reaches into a shelf, from the URDF of example-robot-data: pip install example-robot-data pycollada."""

from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import vgtm_qp as vq

try:
    share = Path(str(distribution("example-robot-data").locate_file("cmeel.prefix/share")))
except PackageNotFoundError:
    raise SystemExit(
        "the Panda's files are not installed: pip install example-robot-data pycollada"
    ) from None

boards = {"lower board": 0.2, "upper board": 0.62}
problem = vq.Problem(
    name="Panda among shelves",
    arm={
        "urdf": str(share / "example-robot-data/robots/panda_description/urdf/panda.urdf"),
        "package_path": [str(share)],
        "tip_link": "panda_hand",
        "home": [0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8],
    },
    curve={"control_vertices": 4},
    maneuver={"steps": 40, "waypoint": [{"time": 8.0, "position": [0.65, -0.25, 0.42]}]},
    obstacle=[
        {"name": name, "shape": "box", "center": [0.75, 0.1, z], "size": [0.4, 0.9, 0.02]}
        for name, z in boards.items()
    ],
    clearance={"safe": 0.02},
)
print(vq.compare(problem, methods=["qp", "pseudoinverse-corrected", "pseudoinverse-obstacles"]))
