"""A maneuver as a figure for print, and as an animation."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import MissingExtraError
from vgtm_qp.result.result import Result
from vgtm_qp.view.figure import each_picture, plot_frames, save_figure

_PAUSE = 0.06
"""s between two pictures: more than 16 a second, in the whole hundredths of a second that GIF counts in."""
_DOTS_PER_INCH = 90
_LONGEST = 12.0
_NEARLY_WHITE = 248


def pdf(maneuver: Result) -> bytes:
    """Return frames of the maneuver side by side as PDF."""
    return _written(".pdf", partial(save_figure, plot_frames(maneuver)))


def png(maneuver: Result) -> bytes:
    """Return frames of the maneuver side by side as PNG."""
    return _written(".png", partial(save_figure, plot_frames(maneuver)))


def gif(maneuver: Result, progress: Callable[[float], None] | None = None) -> bytes:
    """Return the maneuver as an animation in real time, in 12 s if it is longer, with 16 pictures a second.

    See :meth:`Format.content`.
    """
    try:
        from PIL import Image
    except ImportError:
        raise MissingExtraError("export", "pillow") from None
    pictures = _pictures(maneuver, progress)
    # One palette for all frames, so that colours do not flicker and frames differ only where the arm moved.
    middle = Image.fromarray(np.concatenate([pictures[0], pictures[len(pictures) // 2], pictures[-1]]))
    palette: Any = middle.quantize(colors=128, dither=Image.Dither.NONE)
    colours = np.array(palette.getpalette()).reshape(-1, 3)
    colours[colours.min(axis=1) >= _NEARLY_WHITE] = 255
    palette.putpalette(colours.ravel().tolist())
    first, *others = (
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures
    )
    pauses = [round(1000.0 * _PAUSE)] * len(others) + [1500]
    file = BytesIO()
    first.save(file, "GIF", save_all=True, append_images=others, duration=pauses, loop=0, optimize=True)
    return file.getvalue()


def mp4(maneuver: Result, progress: Callable[[float], None] | None = None) -> bytes:
    """Return the animation of :func:`gif` as a video."""
    try:
        import imageio_ffmpeg
    except ImportError:
        raise MissingExtraError("export", "imageio-ffmpeg") from None
    pictures = _pictures(maneuver, progress)

    def write(path: Path) -> None:
        height, width, _ = pictures[0].shape
        fast: dict[str, Any] = {"macro_block_size": 2, "output_params": ["-movflags", "+faststart"]}
        writer = imageio_ffmpeg.write_frames(str(path), (width, height), fps=1.0 / _PAUSE, quality=8, **fast)
        writer.send(None)
        for picture in pictures:
            writer.send(np.ascontiguousarray(picture))
        writer.close()

    return _written(".mp4", write)


def _pictures(maneuver: Result, progress: Callable[[float], None] | None) -> list[NDArray[np.uint8]]:
    """Return (H, W, 3) pictures, H and W even as video needs them, at equal pauses: in real time, or in `_LONGEST`."""
    start, end = float(maneuver.time[0]), float(maneuver.time[-1])
    count = 1 + int(np.ceil(min(end - start, _LONGEST) / _PAUSE))
    pictures = []
    for picture in each_picture(maneuver, np.linspace(start, end, count), _DOTS_PER_INCH):
        pictures.append(picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2])
        if progress is not None:
            progress(len(pictures) / count)
    return pictures


def _written(suffix: str, write: Callable[[Path], object]) -> bytes:
    """Return the bytes that `write` writes; the suffix selects the format."""
    with TemporaryDirectory() as folder:
        path = Path(folder, f"maneuver{suffix}")
        write(path)
        return path.read_bytes()
