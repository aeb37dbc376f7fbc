"""Files with random mistakes, and what the commands that read them make of each.

    python tests/mutations.py 500 [--seed 7]    500 files of each kind, and the exit codes by command

Problem files, result files (manifest and arrays), path files, mesh files and URDF files are mutated. Every command that
takes the file ends with exit code 0, 2, 3 or 4, says what is wrong where it refuses, and shows no traceback.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import io
import json
import os
import secrets
import signal
import struct
import sys
import tempfile
import tomllib
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from problem_texts import ARM, GRAPH, VALID
from urdf_texts import ARM as SMALL

from vgtm_qp.cli import main
from vgtm_qp.export import FORMATS
from vgtm_qp.result.file import content_digest

Rng = np.random.Generator

SECONDS = 120.0
"""A command that takes longer than this hangs."""

VALUES: tuple[Any, ...] = (
    None, True, False, -1, 0, 1, 2, 3, 10**30, 10**400, -0.5, 0.5, 1e-300, 1e300, 1e6, 1e9, 1e-6, float("nan"),
    float("inf"), float("-inf"), "", "text", "box", "graph", "nan", "é\x00", "../..", [], {}, [None], [1.0], [1, 2, 3],
    [0.0, 0.0, 0.0], [1e6, -1e6, 1e6], [[1.0], [2.0, 3.0]], {"a": 1}, {"time": 1.0},
)  # fmt: skip
KEYS = ("name", "shape", "time", "position", "path", "waypoint", "kind", "a.b", "", "é", "velocity", "locked")
BITS = (
    b"",
    b"\n",
    b",",
    b"nan",
    b"1e400",
    b"-",
    b'"',
    b"[",
    b"]",
    b"=",
    b"\x00",
    b"\xff",
    b"9999999999",
    b"0",
    b"#",
)

SCENE = """schema_version = 1
name = "two bays"
[truss]
module = "octahedral"
bays = 2
stroke = [0.6, 1.5]
rate = 0.5
locked = [{ member = "B1-1", time = 0.5 }]
base_motion = [{ time = 1.0, position = [0.0, 0.0, 0.01] }]
[curve]
family = "b-spline"
control_vertices = 4
control_vertex_goals = [{ index = 2, position = [0.1, 0.0, 1.0] }]
[maneuver]
steps = 2
waypoint = [{ time = 2.0, position = [0.05, 0.0, 1.6] }]
[[obstacle]]
name = "cube"
shape = "box"
center = [1.5, 0.0, 1.0]
size = 0.5
velocity = [0.01, 0.0, 0.0]
[[obstacle]]
name = "can"
shape = "cylinder"
center = [-1.5, 0.0, 1.0]
radius = 0.2
height = 0.4
[clearance]
safe = 0.05
influence = 0.5
[method]
retries = false
"""
SNAKE = """schema_version = 1
name = "snake"
[end_effector]
track = ["position"]
[arm]
link_radius = 0.02
tip = [0.0, 0.0, 0.3]
joint = [
  { name = "j1", axis = [1.0, 0.0, 0.0], limits = [-1.5, 1.5], home = 0.1, rate = 1.0 },
  { name = "j2", axis = [0.0, 1.0, 0.0], position = [0.0, 0.0, 0.3], limits = [-1.5, 1.5], home = 0.2 },
  { name = "j3", axis = [1.0, 0.0, 0.0], position = [0.0, 0.0, 0.3], limits = [-1.5, 1.5], home = 0.3 },
  { name = "j4", axis = [0.0, 1.0, 0.0], position = [0.0, 0.0, 0.3], limits = [-1.5, 1.5], home = 0.2 },
]
[maneuver]
steps = 2
[[maneuver.waypoint]]
time = 2.0
position = [0.2, -0.3, 0.9]
[method]
retries = false
"""
INVERSE = SCENE.replace("[method]", '[method]\nname = "pseudoinverse"').replace(
    "control_vertex_goals = [{ index = 2, position = [0.1, 0.0, 1.0] }]\n", ""
)
CUBES = VALID.replace("steps = 50", "steps = 3").replace('name = "qp"', 'name = "qp"\nretries = false')
ALONG = """schema_version = 1
name = "along"
[truss]
module = "octahedral"
bays = 2
[curve]
control_vertices = 4
[maneuver]
path = "path.csv"
approach_steps = 2
[method]
retries = false
"""
AMONG = """schema_version = 1
name = "among"
[truss]
module = "octahedral"
bays = 2
[curve]
control_vertices = 4
[maneuver]
steps = 2
waypoint = [{{ time = 2.0, position = [0.05, 0.0, 1.6] }}]
[[obstacle]]
name = "part"
shape = "mesh"
file = "part{suffix}"
center = [1.2, 0.0, 0.8]
[method]
retries = false
"""
ROBOT = """schema_version = 1
name = "robot"
arm = {{ urdf = "{file}", tip_link = "tool" }}
curve = {{ control_vertices = 3 }}
obstacle = [{{ name = "ball", shape = "sphere", center = [0.5, 0.5, 0.5], radius = 0.1 }}]
maneuver = {{ steps = 2, waypoint = [{{ time = 2.0, position = [0.82, 0.1, 0.3] }}] }}
method = {{ retries = false }}
"""
ROWS = "t,x,y,z\n0,0.0,0.0,1.6\n0.2,0.01,0.0,1.6\n0.4,0.02,0.0,1.59\n"
URDF = SMALL.replace('<sphere radius="0.08"/>', '<mesh filename="part.stl" scale="0.3 0.3 0.3"/>')
CORNERS = np.array([[x, y, z] for x in (0.0, 0.3) for y in (0.0, 0.3) for z in (0.0, 0.3)])
FACES = [
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
    [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
]  # fmt: skip


def meshes() -> dict[str, bytes]:
    """A cube as a mesh file of each kind, by suffix; those of the binary kinds begin with a dot more."""
    solid = ["solid cube"]
    for face in FACES:
        corners = [f"vertex {x} {y} {z}" for x, y, z in CORNERS[face]]
        solid += ["facet normal 0 0 0", "outer loop", *corners, "endloop", "endfacet"]
    triangles = CORNERS[FACES].astype("<f4").reshape(len(FACES), 9)
    records = [np.zeros(3, "<f4").tobytes() + row.tobytes() + b"\0\0" for row in triangles]
    vertices, faces = len(CORNERS), len(FACES)
    points = "\n".join(f"{x} {y} {z}" for x, y, z in CORNERS)
    sides = "\n".join(f"3 {a} {b} {c}" for a, b, c in FACES)
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    return {
        ".stl": "\n".join([*solid, "endsolid cube\n"]).encode(),
        "2.stl": bytes(80) + struct.pack("<I", faces) + b"".join(records),
        ".obj": "".join(
            [f"v {x} {y} {z}\n" for x, y, z in CORNERS]
            + [f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in FACES]
        ).encode(),
        ".off": f"OFF\n{vertices} {faces} 0\n{points}\n{sides}\n".encode(),
        ".ply": (
            f"ply\nformat ascii 1.0\nelement vertex {vertices}\n{properties}element face {faces}\n"
            f"property list uchar int vertex_indices\nend_header\n{points}\n{sides}\n"
        ).encode(),
    }


def places(value: Any, here: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Every place of tables and arrays inside one another; of long arrays the first and the last entry."""
    if here:
        yield here
    if isinstance(value, dict):
        for key in value:
            yield from places(value[key], (*here, key))
    elif isinstance(value, list) and value:
        for k in sorted({0, len(value) - 1}):
            yield from places(value[k], (*here, k))


def altered(data: Any, rng: Rng) -> Any:
    """Return tables and arrays with one to three values deleted, replaced, renamed, added, repeated or wrapped."""
    data = copy.deepcopy(data)
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        found = list(places(data))
        if not found:
            break
        *outer, last = found[rng.integers(len(found))]
        table = data
        for part in outer:
            table = table[part]
        change = rng.choice(
            ["delete", "replace", "replace", "scale", "scale", "scale", "rename", "add", "repeat", "wrap"]
        )
        value = copy.deepcopy(VALUES[rng.integers(len(VALUES))])
        if change == "delete":
            del table[last]
        elif change == "scale" and type(table[last]) in (int, float):
            kind = float if abs(table[last]) > 99 else type(table[last])
            table[last] = kind(
                table[last] * float(rng.choice([-1.0, 0.0, 1e-6, 0.5, 0.99, 1.01, 2.0, 7.0, 1e6]))
            )
        elif change == "rename" and isinstance(table, dict):
            table[str(last) + "s"] = table.pop(last)
        elif change == "add" and isinstance(table[last], dict):
            table[last][str(rng.choice(KEYS))] = value
        elif change == "repeat" and isinstance(table, list):
            table.append(copy.deepcopy(table[last]))
        elif change == "wrap":
            table[last] = [table[last]]
        else:
            table[last] = value
    return data


def damaged(raw: bytes, rng: Rng) -> bytes:
    """Return bytes of which some are replaced, dropped, doubled or cut off."""
    found = bytearray(raw)
    for _ in range(rng.choice([1, 1, 2])):
        start = int(rng.integers(len(found) + 1))
        stop = start + int(rng.integers(0, 12))
        change = rng.integers(6)
        if change == 0:
            del found[start:]
        elif change == 1:
            found[start:start] = found[start:stop]
        elif change == 2:
            found[start:stop] = rng.integers(0, 256, stop - start).astype(np.uint8).tobytes()
        else:
            found[start:stop] = BITS[rng.integers(len(BITS))]
    return bytes(found)


def edited(text: str, rng: Rng) -> str:
    """Return a text whose lines are dropped, doubled, swapped or cut, or whose words are others."""
    lines = text.splitlines()
    for _ in range(rng.choice([1, 1, 2])):
        if not lines:
            break
        k, change = int(rng.integers(len(lines))), rng.integers(6)
        if change == 0:
            del lines[k]
        elif change == 1:
            lines.insert(k, lines[k])
        elif change == 2:
            j = int(rng.integers(len(lines)))
            lines[k], lines[j] = lines[j], lines[k]
        elif change == 3:
            lines[k] = lines[k][: int(rng.integers(len(lines[k]) + 1))]
        else:
            separator = "," if "," in lines[k] else " "
            words = lines[k].split(separator)
            j = int(rng.integers(len(words)))
            with contextlib.suppress(ValueError):
                words[j] = repr(float(words[j]) * rng.normal(1.0, 0.1) + rng.normal(0.0, 0.01))
            if rng.random() < 0.3:
                words[j] = str(VALUES[rng.integers(len(VALUES))])[:60]
            lines[k] = separator.join(words)
    return "\n".join(lines) + "\n"


def toml(value: Any) -> str:
    """Return a value as TOML has it, tables in one line; what TOML has no form for becomes an empty string."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(key)} = {toml(inner)}" for key, inner in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(toml(inner) for inner in value) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return str(value) if isinstance(value, int | float) else json.dumps(value or "")


def document(data: dict[str, Any]) -> str:
    """Return a whole TOML document."""
    return "".join(f"{json.dumps(key)} = {toml(value)}\n" for key, value in data.items())


class Bench:
    """A folder with sound files, and the commands that read mutated ones; counts the exit codes of each command."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.codes = folder, Counter[tuple[str, str, int]]()
        self._sound: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {}
        (folder / "path.csv").write_text(ROWS)
        for suffix, raw in meshes().items():
            (folder / f"part{suffix}").write_bytes(raw)
        (folder / "small.urdf").write_text(URDF)
        texts = {"scene": SCENE, "snake": SNAKE, "along": ALONG, "among": AMONG.format(suffix=".stl")}
        texts["robot"] = ROBOT.format(file="small.urdf")
        for name, text in texts.items():
            (folder / f"{name}.toml").write_text(text)
            code, said = self.run("sound", "solve", f"{name}.toml", "-o", f"{name}.npz")
            assert code == 0, said
            with np.load(folder / f"{name}.npz") as file:
                content = dict(file)
            self._sound[name] = content, json.loads(str(content.pop("manifest")))

    def run(self, kind: str, *tokens: str) -> tuple[int, str]:
        """Run a command in the folder; return its exit code and all that it said, checked."""

        def hang(_signal: int, _frame: Any) -> None:
            raise Hang(f"{tokens} takes longer than {SECONDS:g} s")

        out, err = io.StringIO(), io.StringIO()
        before, here = signal.signal(signal.SIGALRM, hang), Path.cwd()
        signal.setitimer(signal.ITIMER_REAL, SECONDS)
        try:
            os.chdir(self.folder)
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                code = main([*tokens, *(["--json"] if tokens[0] != "view" else [])])
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, before)
            os.chdir(here)
        self.codes[kind, tokens[0], code] += 1
        said = f"{' '.join(tokens)}: exit {code}\n{out.getvalue()[-3000:]}\n{err.getvalue()[-6000:]}"
        assert code in (0, 2, 3, 4), said
        assert "Traceback" not in err.getvalue(), said
        if tokens[0] != "view":
            answer = json.loads(out.getvalue())
            if "error" in answer:
                assert code in (2, 4), said
                assert answer["error"], said
                assert err.getvalue().count(answer["error"]) == 1, said
                for mistake in answer["mistakes"]:
                    assert all(mistake[key] for key in ("file", "key", "expected")), said
                if tokens[0] in ("check", "solve"):
                    assert answer["mistakes"], said
            elif tokens[0] == "solve":
                honest = {0: "solved", 3: "blocked"}
                assert answer["status"] == honest.get(code, answer["status"]), said
                assert answer["verified"] is (code != 4), said
        elif code:
            assert err.getvalue().strip(), said
        return code, said

    def problem(self, rng: Rng) -> None:
        """Mutate a problem file."""
        text = str(rng.choice([SCENE, SCENE, INVERSE, SNAKE, SNAKE, CUBES, GRAPH, ARM]))
        if rng.random() < 0.6:
            text = document(altered(tomllib.loads(text), rng))
        elif rng.random() < 0.5:
            text = edited(text, rng)
        else:
            text = damaged(text.encode(), rng).decode("utf-8", "surrogateescape")
        file = self.folder / "wrong.toml"
        file.write_bytes(text.encode("utf-8", "surrogateescape"))
        self.run("problem", "check", file.name)
        self.run("problem", "solve", file.name, "-o", "wrong.npz")
        if (chosen := rng.random()) < 0.1:
            self.run("problem", "compare", file.name, "--methods", "qp,pseudoinverse,curve-pseudoinverse")
        elif chosen < 0.2:
            self.run("problem", "verify", "scene.npz", "--problem", file.name)
        elif chosen < 0.3:
            self.glance("problem", file.name)

    def manifest(self, rng: Rng) -> None:
        """Mutate manifest, arrays or bytes of a result file."""
        content, manifest = self._sound[str(rng.choice(list(self._sound)))]
        content, file = dict(content), self.folder / "wrong.npz"
        chosen = rng.random()
        if chosen < 0.6:
            manifest = altered(manifest, rng)
        elif chosen < 0.9:
            self._alter_array(content, rng)
        try:
            unsigned = {key: value for key, value in manifest.items() if key != "digest"}
            text = json.dumps({**unsigned, "digest": content_digest(content, unsigned)})
        except Exception:
            text = json.dumps(manifest)
        stream = io.BytesIO()
        np.savez(stream, **content, manifest=np.array(text))
        raw = stream.getvalue() if chosen < 0.9 else damaged(stream.getvalue(), rng)
        file.write_bytes(raw)
        self.run("manifest", "verify", file.name)
        export = partial(self.run, "manifest", "export", file.name, "--to")
        commands: list[Callable[[], Any]] = [
            *(
                partial(export, name, "-o", f"x{FORMATS[name].suffix}")
                for name in ("csv", "ros", "mcap", "png")
            ),
            partial(export, "mjcf", "-o", "x.xml"),
            partial(export, "mjcf", "-o", "x.xml"),
            lambda: self.run("manifest", "replay", file.name),
            lambda: self.glance("manifest", file.name),
            lambda: self.plots(file),
        ]
        commands[rng.integers(len(commands))]()

    def _alter_array(self, content: dict[str, Any], rng: Rng) -> None:
        name = str(rng.choice(list(content)))
        array, change = content[name], rng.integers(8)
        if change == 0:
            del content[name]
        elif change == 1:
            content[name] = array[:-1] if array.ndim else array
        elif change == 2:
            content[name] = array[..., None]
        elif change == 3:
            content[name] = array.astype(str)
        elif change == 4:
            content[name + "s"] = array
        elif array.dtype.kind == "f" and array.size:
            content[name] = array = array.copy()
            array.flat[rng.integers(array.size)] = rng.choice([np.nan, np.inf, 1e300, -1e30, 0.0, 1e9])
        else:
            content[name] = array[::-1].copy()

    def path(self, rng: Rng) -> None:
        """Mutate a path file."""
        rows = ROWS
        if rng.random() < 0.2:
            rows = "t,x,y,z,rx,ry,rz\n" + "".join(f"{line},0,0,0.1\n" for line in ROWS.splitlines()[1:])
        raw = edited(rows, rng).encode() if rng.random() < 0.7 else damaged(rows.encode(), rng)
        (self.folder / "wrong.csv").write_bytes(raw)
        (self.folder / "along_wrong.toml").write_text(ALONG.replace("path.csv", "wrong.csv"))
        self.run("path", "check", "along_wrong.toml")
        self.run("path", "solve", "along_wrong.toml", "-o", "along_wrong.npz")
        if rng.random() < 0.2:
            self.run("path", "verify", "along.npz", "--problem", "along_wrong.toml")

    def mesh(self, rng: Rng) -> None:
        """Mutate a mesh file."""
        suffix, raw = list(meshes().items())[rng.integers(5)]
        is_text = suffix != "2.stl"
        raw = edited(raw.decode(), rng).encode() if is_text and rng.random() < 0.7 else damaged(raw, rng)
        (self.folder / f"part_wrong{suffix}").write_bytes(raw)
        (self.folder / "among_wrong.toml").write_text(AMONG.format(suffix=f"_wrong{suffix}"))
        self.run("mesh", "check", "among_wrong.toml")
        code, _ = self.run("mesh", "solve", "among_wrong.toml", "-o", "among_wrong.npz")
        if code != 2 and rng.random() < 0.5:
            (self.folder / f"part_wrong{suffix}").write_bytes(damaged(raw, rng))
            self.run("mesh", "verify", "among_wrong.npz")
            self.run("mesh", "export", "among_wrong.npz", "--to", "mjcf", "-o", "x.xml")
            self.glance("mesh", "among_wrong.npz")

    def urdf(self, rng: Rng) -> None:
        """Mutate a URDF file."""
        chosen = rng.random()
        if chosen < 0.4:
            # Words of XML are between quotation marks.
            parts = URDF.split('"')
            for _ in range(rng.choice([1, 1, 2])):
                k = 1 + 2 * int(rng.integers(len(parts) // 2))
                parts[k] = str(rng.choice([str(VALUES[rng.integers(len(VALUES))])[:60], *parts[1::2]]))
            text = '"'.join(parts).encode()
        else:
            text = edited(URDF, rng).encode() if chosen < 0.7 else damaged(URDF.encode(), rng)
        (self.folder / "wrong.urdf").write_bytes(text)
        (self.folder / "robot_wrong.toml").write_text(ROBOT.format(file="wrong.urdf"))
        self.run("urdf", "check", "robot_wrong.toml")
        code, _ = self.run("urdf", "solve", "robot_wrong.toml", "-o", "robot_wrong.npz")
        if code != 2:
            self.run("urdf", "verify", "robot_wrong.npz")
        if rng.random() < 0.2:
            self.run("urdf", "verify", "robot.npz", "--problem", "robot_wrong.toml")

    def glance(self, kind: str, name: str) -> None:
        """Open the live page of a file, play it a little, and close it."""
        from vgtm_qp.live.page import Page

        def run(page: Page, _stop: Any) -> None:
            page.draw()
            page.post(lambda: page.play(0.5))
            page.read_inbox()
            assert "internal error" not in page.message, page.message

        with patch.object(Page, "run", run):
            self.run(kind, "view", name, "--port", "0")

    def plots(self, file: Path) -> None:
        """Draw every plot of a result file that can be read."""
        import matplotlib.pyplot as plt

        import vgtm_qp as vq

        with contextlib.suppress(vq.ResultError):
            maneuver = vq.load_result(file)
            for name in ("plot_clearance", "plot_strokes", "plot_tip_error", "plot_step_time"):
                with contextlib.suppress(vq.ResultError):
                    getattr(maneuver, name)()
                plt.close("all")


class Hang(BaseException):
    """A command that takes too long; no command may catch it."""


KINDS = ("problem", "manifest", "path", "mesh", "urdf")


def main_script(tokens: Sequence[str] | None = None) -> int:
    """Mutate as many files of each kind as asked, print what fails, and the exit codes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("count", type=int)
    parser.add_argument("--seed", type=int, default=secrets.randbits(32))
    parser.add_argument("--kinds", nargs="+", default=KINDS)
    given = parser.parse_args(tokens)
    os.environ.setdefault("VGTM_CC", "none")
    warnings.filterwarnings("error", category=RuntimeWarning, module="vgtm_qp")
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder))
        for kind in given.kinds:
            for k in range(given.count):
                try:
                    getattr(bench, kind)(np.random.default_rng([given.seed, KINDS.index(kind), k]))
                except (Exception, Hang) as error:
                    failed += 1
                    print(f"--- {kind} {k} of seed {given.seed}: {type(error).__name__}\n{error}", flush=True)
    for (kind, command, code), count in sorted(bench.codes.items()):
        print(f"{kind:10} {command:8} exit {code}: {count}")
    print(f"seed {given.seed}: {given.count} of each of {', '.join(given.kinds)}, {failed} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main_script())
