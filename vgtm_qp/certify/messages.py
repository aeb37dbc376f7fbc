"""Trajectories in the messages of ROS 2: a bag that holds one, or a JointTrajectory as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vgtm_qp.errors import MissingExtraError, ProblemError
from vgtm_qp.problem.table import shown

MessagePoints = list[tuple[str, float, Sequence[Any]]]
"""Of each point the place in words, the time, s, and the positions of the joints, rad or m."""

_TRAJECTORY, _STATE = "JointTrajectory", "JointState"
_GREATEST_BYTES = 500_000_000


def read_bag(file: Path) -> tuple[list[str], MessagePoints]:
    """Return joint names and points of the one JointTrajectory in an MCAP file, or else of its JointState messages.

    Raises
    ------
    ProblemError
        The file is not a bag, or it holds no trajectory or several.
    MissingExtraError
        The reader is not installed.
    """
    try:
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory
    except ImportError:
        raise MissingExtraError("export", "mcap-ros2-support") from None
    _check_file(file, "an MCAP file")
    found: dict[str, list[tuple[str, Any]]] = {_TRAJECTORY: [], _STATE: []}
    try:
        with file.open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            for schema, channel, _, message in reader.iter_decoded_messages():
                kind = schema.name.rpartition("/")[2] if schema else ""
                if kind in found:
                    found[kind].append((channel.topic, message))
    except Exception as error:  # the reader raises whatever a damaged record leads to
        said = " ".join(str(error).split())[:100] or type(error).__name__
        raise ProblemError.at(file, "file", said, "an MCAP file of ROS 2 messages") from None
    if len(found[_TRAJECTORY]) > 1:
        topics = ", ".join(sorted({topic for topic, _ in found[_TRAJECTORY]}))
        several = f"{len(found[_TRAJECTORY])} JointTrajectory messages, on {topics}"
        raise ProblemError.at(file, "file", several, "one JointTrajectory message")
    if found[_TRAJECTORY]:
        topic, message = found[_TRAJECTORY][0]
        points: MessagePoints = [
            (f"{topic}, point {k}", _seconds(point.time_from_start), list(point.positions))
            for k, point in enumerate(message.points)
        ]
        return list(message.joint_names), points
    if not found[_STATE]:
        raise ProblemError.at(file, "file", "neither", "a JointTrajectory message, or JointState messages")
    return _states(file, found[_STATE])


def _states(file: Path, messages: list[tuple[str, Any]]) -> tuple[list[str], MessagePoints]:
    """Return names and points of JointState messages of one topic, all of the same joints; times are from the first."""
    topics = sorted({topic for topic, _ in messages})
    if len(topics) > 1:
        raise ProblemError.at(file, "file", f"JointState messages on {', '.join(topics)}", "one topic")
    names, begin = list(messages[0][1].name), _seconds(messages[0][1].header.stamp)
    points: MessagePoints = []
    for k, (topic, message) in enumerate(messages):
        if list(message.name) != names:
            found = shown(", ".join(message.name))
            raise ProblemError.at(
                file, f"{topic}, message {k}, name", found, f"{', '.join(names)}, as before"
            )
        time = _seconds(message.header.stamp) - begin
        points.append((f"{topic}, message {k}", time, list(message.position)))
    return names, points


def read_message(file: Path) -> tuple[list[str], MessagePoints]:
    """Return joint names and points of a JointTrajectory as YAML, the form of ``ros2 topic pub``.

    Raises
    ------
    ProblemError
        The file does not hold such a text.
    MissingExtraError
        The reader of YAML is not installed.
    """
    try:
        import yaml
    except ImportError:
        raise MissingExtraError("export", "pyyaml") from None
    _check_file(file, "a YAML file")
    try:
        data = yaml.safe_load(file.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError as error:
        raise ProblemError.at(file, "file", f"byte {error.start}", "text in UTF-8") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        place = f"line {mark.line + 1}, column {mark.column + 1}" if mark else "file"
        said = str(getattr(error, "problem", None) or type(error).__name__)
        raise ProblemError.at(file, place, said[:100], "YAML") from None
    names = _entry(file, data, "joint_names", "message")
    entries = _entry(file, data, "points", "message")
    if not all(isinstance(name, str) for name in names):
        raise ProblemError.at(file, "joint_names", shown(names), "a list of names")
    points: MessagePoints = []
    for k, point in enumerate(entries):
        place = f"points[{k}]"
        start = point.get("time_from_start") if isinstance(point, Mapping) else None
        stamp = start if isinstance(start, Mapping) else {"sec": None}
        whole, rest = stamp.get("sec", 0), stamp.get("nanosec", 0)
        if type(whole) is not int or type(rest) is not int:
            raise ProblemError.at(
                file, f"{place}, time_from_start", shown(start), "sec and nanosec, integers"
            )
        positions = _entry(file, point, "positions", place)
        points.append((place, float(whole) + 1e-9 * float(rest), positions))
    return list(names), points


def _entry(file: Path, table: Any, key: str, place: str) -> Sequence[Any]:
    value = table.get(key) if isinstance(table, Mapping) else None
    if not isinstance(value, list):
        raise ProblemError.at(file, f"{place}, {key}", shown(value), "a list, as a JointTrajectory has it")
    return value


def _seconds(stamp: Any) -> float:
    """Return a stamp or a duration, s; some versions of the decoder give a duration as an instant."""
    whole = getattr(stamp, "sec", getattr(stamp, "secs", 0))
    return float(whole) + 1e-9 * float(getattr(stamp, "nanosec", getattr(stamp, "nsecs", 0)))


def _check_file(file: Path, expected: str) -> None:
    try:
        if not file.is_file():
            raise ProblemError.at(file, "file", "nothing", expected)
        if file.stat().st_size > _GREATEST_BYTES:
            raise ProblemError.at(file, "file", "a huge file", f"less than {_GREATEST_BYTES} bytes")
        with file.open("rb"):
            pass
    except (OSError, ValueError) as error:
        said = getattr(error, "strerror", None) or str(error)
        raise ProblemError.at(file, "file", said, "a readable file") from None
