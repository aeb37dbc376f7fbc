"""The tables of keys in problems/README.md, made from the schema; ``python tests/key_reference.py`` writes them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from vgtm_qp.problem import problem_schema

DOCUMENT = Path(__file__).resolve().parents[1] / "problems" / "README.md"

# What stands in each table of the problem-file reference.
TABLES = {
    "[truss]": ("ModuleTruss", "TetrahedralTruss", "GraphTruss"),
    "[[truss.node]]": ("Node",),
    "[[truss.member]]": ("Member",),
    "[[truss.locked]]": ("Lock",),
    "[[truss.base_motion]]": ("BasePose",),
    "[arm]": ("ArmTable",),
    "[[arm.joint]]": ("Joint",),
    "[arm.joint.mimic]": ("Mimic",),
    "[[arm.body]]": ("ArmBody",),
    "[[arm.locked]]": ("JointLock",),
    "[curve]": ("BezierCurve", "BSplineCurve", "BetaSplineCurve", "SegmentCurve"),
    "[[curve.control_vertex_goals]]": ("VertexGoal",),
    "[end_effector]": ("EndEffector",),
    "[maneuver]": ("WaypointManeuver", "PathManeuver"),
    "[[maneuver.waypoint]]": ("Waypoint",),
    "[[obstacle]]": ("Box", "Sphere", "Cylinder", "Mesh"),
    "[clearance]": ("ClearanceTable",),
    "[method]": ("Method",),
    "[method.weights]": ("Weights",),
    "[method.gains]": ("Gains",),
}


def reference(models: tuple[str, ...]) -> list[str]:
    """Return the rows that the schema gives a table: key, default, meaning; the first model has the word."""
    definitions = problem_schema()["$defs"]
    found: dict[str, tuple[str, str, list[str]]] = {}
    for model in models:
        definition = definitions[model]
        definition = definition if "properties" in definition else definition["anyOf"][1]
        for key, value in definition["properties"].items():
            if "$ref" in value:
                continue
            default = "required" if key in definition.get("required", ()) else _written(value["default"])
            *_, choices = found.setdefault(key, (default, value.get("description", ""), []))
            choices += value.get("enum", [value["const"]] if "const" in value else [])
    ordered = sorted(found.items(), key=lambda item: item[0] not in ("module", "family", "shape"))
    return [
        f"| `{key}` | {default} | {_meaning(text, choices)} |" for key, (default, text, choices) in ordered
    ]


def _meaning(text: str, choices: list[str]) -> str:
    """Return the description in a cell of Markdown, with the choices that it does not name."""
    unnamed = list(dict.fromkeys(choice for choice in choices if choice not in text))
    listed = ", ".join(f'"{choice}"' for choice in (dict.fromkeys(choices) if unnamed else ()))
    return "; ".join(part for part in (text, listed) if part).replace("|", r"\|")


def _written(default: Any) -> str:
    if default is None:
        return "-"
    if isinstance(default, bool | str):
        return f"`{json.dumps(default)}`"
    if isinstance(default, list):
        return f"`[{', '.join(f'{x:g}' if isinstance(x, float) else json.dumps(x) for x in default)}]`"
    return f"{default:g}"


def written(document: str) -> str:
    """Return a document with the rows of all tables as the schema gives them."""
    for name, models in TABLES.items():
        rows = "".join(f"{row}\n" for row in reference(models))
        table = re.compile(
            rf"^(\| {re.escape(f'`{name}`')} \|[^\n]*\n\|[-|]+\|\n)(?:\|[^\n]*\n)*", re.MULTILINE
        )
        document, found = table.subn(lambda head, rows=rows: head[1] + rows, document)
        if found != 1:
            raise ValueError(f"{DOCUMENT} needs one table headed `{name}`")
    return document


if __name__ == "__main__":
    DOCUMENT.write_text(written(DOCUMENT.read_text(encoding="utf-8")), encoding="utf-8")
