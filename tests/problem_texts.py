"""Problem files that are right, for the tests that make them wrong."""

VALID = """
schema_version = 1
[truss]
module = "octahedral"
bays = 5
stroke = [0.6, 1.5]
[curve]
family = "bezier"
control_vertices = 6
[end_effector]
track = ["position"]
[maneuver]
steps = 50
[[maneuver.waypoint]]
time = 10.0
position = [1.6, 0.0, 3.3]
[[obstacle]]
name = "left cube"
shape = "box"
center = [-1.15, 0.0, 2.6]
size = 0.9
[[obstacle]]
name = "right cube"
shape = "box"
center = [1.15, 0.0, 2.2]
size = 0.9
[clearance]
safe = 0.08
[method]
name = "qp"
[method.weights]
actuator_rate = 0.5
"""

GRAPH = """
schema_version = 1
[truss]
module = "graph"
tip = ["d"]
node = [
  { name = "a", position = [0, 0, 0], fixed = true }, { name = "b", position = [1, 0, 0], fixed = true },
  { name = "c", position = [0, 1, 0], fixed = true }, { name = "d", position = [0, 0, 1] },
]
member = [
  { name = "ad", nodes = ["a", "d"], actuated = true, stroke = [0.5, 1.5] },
  { name = "bd", nodes = ["b", "d"] }, { name = "cd", nodes = ["c", "d"] },
]
[[maneuver.waypoint]]
time = 1.0
position = [0.1, 0.0, 1.0]
"""

ARM = """
schema_version = 1
[[arm.joint]]
name = "base"
axis = [0, 0, 1]
limits = [-1.0, 1.0]
[[maneuver.waypoint]]
time = 1.0
position = [0.1, 0.0, 1.0]
"""
