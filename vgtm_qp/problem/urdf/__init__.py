"""Serial arms from URDF files: their joints, their end effector, and bodies that enclose their collision shapes."""

from vgtm_qp.problem.urdf.reader import UrdfArm, UrdfBody, UrdfJoint, read_urdf, read_visuals
from vgtm_qp.problem.urdf.visuals import UrdfVisual

__all__ = ["UrdfArm", "UrdfBody", "UrdfJoint", "UrdfVisual", "read_urdf", "read_visuals"]
