"""The measuring instrument: the time of a step by phase, beside baselines that take the same steps."""

from typing import Literal

SceneKind = Literal["free", "cubes", "pointing", "clutter", "tetrahedral", "serial", "snake"]
TrackingName = Literal["exact", "elastic", "hard"]
DistanceName = Literal["fcl", "exact"]
BaselineName = Literal["eq28", "eq28-sparse", "curve", "ipopt", "osqp", "piqp", "mink", "pink"]
