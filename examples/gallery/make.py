"""Makes the pictures of the gallery again: runs the commands in ``examples/README.md``, and stores what they draw.

``python examples/gallery/make.py`` makes all of them, ``python examples/gallery/make.py snake circle`` these.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image, ImageSequence

EXAMPLES = Path(__file__).resolve().parents[1]
DOCUMENT = EXAMPLES / "README.md"
WIDEST = {".png": 900, ".gif": 440}
"""Pixels."""
COLOURS = {".png": 256, ".gif": 96}
NEARLY_WHITE = 246


def pictures() -> Iterator[tuple[str, str]]:
    """Yield picture, relative to the folder of examples, and command of each row of the gallery."""
    row = r"^\| !\[[^\]]+\]\(([\w/.]+)\) [^|]* \| `([^`]+)` \|$"
    yield from re.findall(row, DOCUMENT.read_text(encoding="utf-8"), flags=re.MULTILINE)


def make(picture: str, command: str) -> None:
    """Run a command in a folder of its own, which has the examples, and store the picture that it leaves there."""
    file = EXAMPLES / picture
    with TemporaryDirectory() as folder:
        shutil.copytree(EXAMPLES, Path(folder, "examples"), ignore=shutil.ignore_patterns("*.png", "*.gif"))
        places = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
        subprocess.run(command, shell=True, cwd=folder, check=True, env={**os.environ, "PATH": places})
        made = next(
            path for path in (Path(folder, file.name), Path(folder, "out", file.name)) if path.exists()
        )
        store(made, file)
    print(f"{picture}: {file.stat().st_size / 1000:.0f} kB")


def store(made: Path, file: Path) -> None:
    """Write a picture with fewer pixels and colours."""
    kind = file.suffix
    with Image.open(made) as image:
        size = WIDEST[kind], round(image.height * WIDEST[kind] / image.width)
        pauses, frames = [], []
        for frame in ImageSequence.Iterator(image):
            pauses.append(frame.info.get("duration", 0))
            frames.append(frame.convert("RGB").resize(size, Image.Resampling.LANCZOS))
    # The colours of the first and last frame stand for all. White stays white.
    ends = Image.new("RGB", (size[0], 2 * size[1]))
    ends.paste(frames[0])
    ends.paste(frames[-1], (0, size[1]))
    palette = ends.quantize(COLOURS[kind], method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    colours = palette.getpalette()
    whites = [k for k in range(0, len(colours), 3) if min(colours[k : k + 3]) >= NEARLY_WHITE]
    palette.putpalette([255 if k - k % 3 in whites else value for k, value in enumerate(colours)])
    first, *others = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    if others:
        first.save(file, save_all=True, append_images=others, duration=pauses, loop=0, optimize=True)
    else:
        first.save(file, optimize=True)


def main(names: Sequence[str]) -> None:
    """Make the pictures with these names, or all."""
    for picture, command in pictures():
        if not names or Path(picture).stem in names:
            make(picture, command)


if __name__ == "__main__":
    main(sys.argv[1:])
