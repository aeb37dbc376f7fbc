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
from vgtm_qp.view.figure import each_frame, plot_frames, save_figure

_MOST_FRAMES = 120
_DOTS_PER_INCH = 100
_LONGEST = 12.0
_NEARLY_WHITE = 248


def pdf(maneuver: Result) -> bytes:
    """Return frames of the maneuver side by side as PDF."""
    return _written(".pdf", partial(save_figure, plot_frames(maneuver)))


def png(maneuver: Result) -> bytes:
    """Return frames of the maneuver side by side as PNG."""
    return _written(".png", partial(save_figure, plot_frames(maneuver)))


def gif(maneuver: Result, progress: Callable[[float], None] | None = None) -> bytes:
    """Return the maneuver as an animation in real time, in 12 s if it is longer; see :meth:`Format.content`."""
    try:
        from PIL import Image
    except ImportError:
        raise MissingExtraError("export", "pillow") from None
    pictures, duration = _pictures(maneuver, progress)
    # One palette for all frames, so that colours do not flicker and frames differ only where the arm moved.
    middle = Image.fromarray(np.concatenate([pictures[0], pictures[len(pictures) // 2], pictures[-1]]))
    palette: Any = middle.quantize(colors=128, dither=Image.Dither.NONE)
    colours = np.array(palette.getpalette()).reshape(-1, 3)
    colours[colours.min(axis=1) >= _NEARLY_WHITE] = 255
    palette.putpalette(colours.ravel().tolist())
    first, *others = (
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures
    )
    pauses = [max(20, round(1000.0 * duration / len(pictures)))] * len(others) + [1500]
    file = BytesIO()
    first.save(file, "GIF", save_all=True, append_images=others, duration=pauses, loop=0, optimize=True)
    return file.getvalue()


def mp4(maneuver: Result, progress: Callable[[float], None] | None = None) -> bytes:
    """Return the animation of :func:`gif` as a video."""
    try:
        import imageio_ffmpeg
    except ImportError:
        raise MissingExtraError("export", "imageio-ffmpeg") from None
    pictures, duration = _pictures(maneuver, progress)

    def write(path: Path) -> None:
        height, width, _ = pictures[0].shape
        rate = max(1.0, len(pictures) / duration)
        fast: dict[str, Any] = {"macro_block_size": 2, "output_params": ["-movflags", "+faststart"]}
        writer = imageio_ffmpeg.write_frames(str(path), (width, height), fps=rate, quality=8, **fast)
        writer.send(None)
        for picture in pictures:
            writer.send(np.ascontiguousarray(picture))
        writer.close()

    return _written(".mp4", write)


def _pictures(
    maneuver: Result, progress: Callable[[float], None] | None
) -> tuple[list[NDArray[np.uint8]], float]:
    """Return (H, W, 3) pictures, H and W even as video needs them, and the duration of all, s."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    count = len(maneuver.time)
    rows = np.unique(np.linspace(0, count - 1, min(count, _MOST_FRAMES)).round().astype(int))
    pictures = []
    for figure in each_frame(maneuver, rows.tolist()):
        figure.set_dpi(_DOTS_PER_INCH)
        canvas: Any = FigureCanvasAgg(figure)
        canvas.draw()
        picture = np.asarray(canvas.buffer_rgba())[..., :3]
        pictures.append(picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2].copy())
        if progress is not None:
            progress(len(pictures) / len(rows))
    return pictures, min(float(maneuver.time[-1] - maneuver.time[0]), _LONGEST) or 1.0


def _written(suffix: str, write: Callable[[Path], object]) -> bytes:
    """Return the bytes that `write` writes; the suffix selects the format."""
    with TemporaryDirectory() as folder:
        path = Path(folder, f"maneuver{suffix}")
        write(path)
        return path.read_bytes()
