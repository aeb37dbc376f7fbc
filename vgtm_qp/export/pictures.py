"""A maneuver as a figure for print, and as an animation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import ExportError, MissingExtraError
from vgtm_qp.result.result import Result

_MOST_FRAMES = 120
_DOTS_PER_INCH = 100
_LONGEST = 12.0
_NEARLY_WHITE = 248


def write_figure(maneuver: Result, path: str | Path) -> Path:
    """Write frames of the maneuver side by side, as .pdf or .png."""
    from vgtm_qp.view.figure import plot_frames, save_figure

    return save_figure(plot_frames(maneuver), path)


def write_animation(maneuver: Result, path: str | Path) -> Path:
    """Write the maneuver as .gif or .mp4, in its own time, or in 12 s where it is longer.

    Raises
    ------
    MissingExtraError
        The package that writes it is not installed.
    ExportError
        The file is neither .gif nor .mp4.
    """
    path = Path(path)
    pictures = _pictures(maneuver)
    duration = min(float(maneuver.time[-1] - maneuver.time[0]), _LONGEST) or 1.0
    if path.suffix.lower() == ".gif":
        _write_gif(pictures, path, duration)
    elif path.suffix.lower() == ".mp4":
        _write_mp4(pictures, path, duration)
    else:
        raise ExportError(f'{path}: an animation cannot be "{path.suffix}"; choices: .gif, .mp4')
    return path


def _pictures(maneuver: Result) -> list[NDArray[np.uint8]]:
    """Return (H, W, 3) pictures, H and W even as video wants them."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from vgtm_qp.view.figure import each_frame

    count = len(maneuver.time)
    rows = np.unique(np.linspace(0, count - 1, min(count, _MOST_FRAMES)).round().astype(int))
    pictures = []
    for figure in each_frame(maneuver, [int(row) for row in rows]):
        figure.set_dpi(_DOTS_PER_INCH)
        canvas: Any = FigureCanvasAgg(figure)
        canvas.draw()
        picture = np.asarray(canvas.buffer_rgba())[..., :3]
        pictures.append(picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2].copy())
    return pictures


def _write_gif(pictures: list[NDArray[np.uint8]], path: Path, duration: float) -> None:
    try:
        from PIL import Image
    except ImportError:
        raise MissingExtraError("export", "pillow") from None
    # One palette for all frames, so that colours do not flicker and frames differ only where the arm moved.
    middle = Image.fromarray(np.concatenate([pictures[0], pictures[len(pictures) // 2], pictures[-1]]))
    palette: Any = middle.quantize(colors=128, dither=Image.Dither.NONE)
    colours = np.array(palette.getpalette()).reshape(-1, 3)
    colours[colours.min(axis=1) >= _NEARLY_WHITE] = 255
    palette.putpalette(colours.ravel().tolist())
    frames = [
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures
    ]
    milliseconds = max(20, round(1000.0 * duration / len(frames)))
    pauses = [milliseconds] * (len(frames) - 1) + [1500]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=pauses, loop=0, optimize=True)


def _write_mp4(pictures: list[NDArray[np.uint8]], path: Path, duration: float) -> None:
    try:
        import imageio_ffmpeg
    except ImportError:
        raise MissingExtraError("export", "imageio-ffmpeg") from None
    height, width, _ = pictures[0].shape
    rate = max(1.0, len(pictures) / duration)
    writer = imageio_ffmpeg.write_frames(
        str(path),
        (width, height),
        fps=rate,
        macro_block_size=2,
        quality=8,
        output_params=["-movflags", "+faststart"],
    )
    writer.send(None)
    for picture in pictures:
        writer.send(np.ascontiguousarray(picture))
    writer.close()
