"""Serial arms from URDF files: their joints, their end effector, and bodies that enclose their collision shapes."""

from vgtm_qp.problem.urdf.reader import UrdfArm, UrdfBody, UrdfJoint, read_urdf

__all__ = ["UrdfArm", "UrdfBody", "UrdfJoint", "read_urdf"]
