"""Actuator lengths over time, as a table, a ROS 2 bag and a trajectory message."""

from __future__ import annotations

import csv
import logging
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import ExportError, MissingExtraError
from vgtm_qp.result.file import replacing
from vgtm_qp.result.result import Result

_LOG = logging.getLogger(__name__)

_HEADER = """std_msgs/Header header
{own}
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec"""

JOINT_STATE = _HEADER.format(own="string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort")
"""Definition of sensor_msgs/msg/JointState, as bags have it."""

JOINT_TRAJECTORY = (
    _HEADER.format(own="string[] joint_names\ntrajectory_msgs/JointTrajectoryPoint[] points")
    + """
================================================================================
MSG: trajectory_msgs/JointTrajectoryPoint
float64[] positions
float64[] velocities
float64[] accelerations
float64[] effort
builtin_interfaces/Duration time_from_start
================================================================================
MSG: builtin_interfaces/Duration
int32 sec
uint32 nanosec"""
)
"""Definition of trajectory_msgs/msg/JointTrajectory."""

METADATA = "metadata.yaml"
"""Name of the file that makes a folder a ROS 2 bag."""
_BAG = "rosbag2_bagfile_information"
_TRAJECTORY = ("/joint_trajectory", "trajectory_msgs/msg/JointTrajectory")
_STATES = ("/joint_states", "sensor_msgs/msg/JointState")
"""Topics of a bag, with their types."""


def step_rates(maneuver: Result) -> Array:
    """Return (T, n_a) mean rates over the step that led to each state, m/s, as rate limits define them."""
    rates = np.zeros_like(maneuver.actuator_values)
    rates[1:] = np.diff(maneuver.actuator_values, axis=0) / np.diff(maneuver.time)[:, None]
    return rates


def through_rates(maneuver: Result) -> Array:
    """Return (T, n_a) rates with which a controller passes the states, m/s: central, and zero at both ends.

    A central rate lies between the mean rates of its two steps, and so within the limits that these keep.
    """
    rates = np.zeros_like(maneuver.actuator_values)
    steps, durations = step_rates(maneuver)[1:], np.diff(maneuver.time)[:, None]
    rates[1:-1] = (durations[1:] * steps[:-1] + durations[:-1] * steps[1:]) / (durations[1:] + durations[:-1])
    return rates


def csv_text(maneuver: Result) -> str:
    """Return CSV, a row a state: time, s, actuators' values, m or rad, and rates over the step before."""
    names = list(zip(maneuver.actuator_names, maneuver.actuator_units, strict=True))
    values = [f"{name} [{unit}]" for name, unit in names]
    rates = [f"d {name}/dt [{unit}/s]" for name, unit in names]
    file = StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["time [s]", *values, *rates])
    writer.writerows(
        np.column_stack([maneuver.time, maneuver.actuator_values, step_rates(maneuver)]).tolist()
    )
    return file.getvalue()


def joint_trajectory(maneuver: Result) -> dict[str, Any]:
    """Return the fields of a ``trajectory_msgs/msg/JointTrajectory``; positions are lengths or joint values."""
    start = float(maneuver.time[0])
    points = [
        {
            "positions": values,
            "velocities": rates,
            "accelerations": [],
            "effort": [],
            "time_from_start": _split(float(time) - start),
        }
        for time, values, rates in zip(
            maneuver.time, maneuver.actuator_values.tolist(), through_rates(maneuver).tolist(), strict=True
        )
    ]
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "base"},
        "joint_names": list(maneuver.actuator_names),
        "points": points,
    }


def ros_text(maneuver: Result) -> str:
    """Return a JointTrajectory as YAML, in the form that ``ros2 topic pub`` takes."""
    return str(
        _yaml().safe_dump(joint_trajectory(maneuver), sort_keys=False, default_flow_style=None, width=10_000)
    )


def mcap_bytes(maneuver: Result) -> bytes:
    """Return a ROS 2 bag: one JointState a state, and the whole JointTrajectory at its start."""
    try:
        from mcap_ros2.writer import Writer
    except ImportError:
        raise MissingExtraError("export", "mcap-ros2-support") from None
    # Needed for the metadata, and missed before anything is written.
    _yaml()
    trajectory, file = joint_trajectory(maneuver), BytesIO()
    with Writer(file) as writer:
        state_schema = writer.register_msgdef(_STATES[1], JOINT_STATE)
        trajectory_schema = writer.register_msgdef(_TRAJECTORY[1], JOINT_TRAJECTORY)
        first = _nanoseconds(float(maneuver.time[0]))
        writer.write_message(_TRAJECTORY[0], trajectory_schema, trajectory, first, first)
        for k, (time, point) in enumerate(zip(maneuver.time, trajectory["points"], strict=True)):
            message = {
                "header": {"stamp": _split(float(time)), "frame_id": "base"},
                "name": trajectory["joint_names"],
                "position": point["positions"],
                "velocity": point["velocities"],
                "effort": [],
            }
            stamp = _nanoseconds(float(time))
            writer.write_message(_STATES[0], state_schema, message, stamp, stamp, sequence=k)
    return file.getvalue()


def describe_bag(maneuver: Result, path: Path) -> None:
    """Write the ``metadata.yaml`` of the bag `path` beside it, by which its folder opens as a ROS 2 bag.

    A file of that name that is about other files is left as it is, with a warning.
    """
    file = path.with_name(METADATA)
    if file.exists() and bag_files(path.parent) != [path.name]:
        _LOG.warning(
            "%s is about other files, and left as it is: a folder opens as one ROS 2 bag; write %s into another",
            file,
            path.name,
        )
        return
    with replacing(file, ExportError) as scratch:
        scratch.write_text(metadata_text(maneuver, path.name), encoding="utf-8")


def bag_files(folder: Path) -> list[str] | None:
    """Return the files of the ROS 2 bag that a folder is, by its ``metadata.yaml``; None where it is none."""
    yaml = _yaml()
    try:
        found = yaml.safe_load((folder / METADATA).read_text(encoding="utf-8"))
        return [str(name) for name in found[_BAG]["relative_file_paths"]]
    except (OSError, ValueError, LookupError, TypeError, yaml.YAMLError):
        return None


def metadata_text(maneuver: Result, name: str) -> str:
    """Return the metadata of a bag in the file `name`, in version 5: all of ROS 2 since Humble reads that."""
    first, last = (_nanoseconds(float(time)) for time in maneuver.time[[0, -1]])
    counts = {_TRAJECTORY: 1, _STATES: len(maneuver.time)}
    span = {
        "duration": {"nanoseconds": last - first},
        "starting_time": {"nanoseconds_since_epoch": first},
        "message_count": sum(counts.values()),
    }
    topics = [
        {
            "topic_metadata": {
                "name": topic,
                "type": kind,
                "serialization_format": "cdr",
                "offered_qos_profiles": "",
            },
            "message_count": count,
        }
        for (topic, kind), count in counts.items()
    ]
    found = {
        "version": 5,
        "storage_identifier": "mcap",
        "relative_file_paths": [name],
        **span,
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "files": [{"path": name, **span}],
    }
    return str(_yaml().safe_dump({_BAG: found}, sort_keys=False))


def _yaml() -> Any:
    try:
        import yaml
    except ImportError:
        raise MissingExtraError("export", "pyyaml") from None
    return yaml


def _nanoseconds(seconds: float) -> int:
    if not 0.0 <= seconds < 2.0**31:
        raise ExportError(f"ROS has times from 0 to {2**31} s; this maneuver is at {seconds:g} s")
    return round(1e9 * seconds)


def _split(seconds: float) -> dict[str, int]:
    whole, rest = divmod(_nanoseconds(seconds), 1_000_000_000)
    return {"sec": whole, "nanosec": rest}
