"""The formats by name, and the one function that writes any of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from vgtm_qp.errors import ExportError, nearest

if TYPE_CHECKING:
    from vgtm_qp.result.result import Result


@dataclass(frozen=True)
class Format:
    """One form of a maneuver.

    Attributes
    ----------
    suffix : str
        What its files end in.
    description : str
        What is in them.
    module, function : str
        Where the function ``(maneuver, path) -> path`` is; imported when it is used.
    """

    suffix: str
    description: str
    module: str
    function: str

    @property
    def write(self) -> Callable[[Result, str | Path], Path]:
        """The function that writes it."""
        write: Callable[[Result, str | Path], Path] = getattr(import_module(self.module), self.function)
        return write


FORMATS = {
    "html": Format(".html", "one offline page with a play bar", "vgtm_qp.export.html", "write_html"),
    "gif": Format(".gif", "an animation", "vgtm_qp.export.pictures", "write_animation"),
    "mp4": Format(".mp4", "an animation", "vgtm_qp.export.pictures", "write_animation"),
    "pdf": Format(".pdf", "a figure for print", "vgtm_qp.export.pictures", "write_figure"),
    "png": Format(".png", "a figure", "vgtm_qp.export.pictures", "write_figure"),
    "csv": Format(".csv", "actuator lengths and rates", "vgtm_qp.export.trajectory", "write_csv"),
    "mcap": Format(".mcap", "a ROS 2 bag", "vgtm_qp.export.trajectory", "write_mcap"),
    "ros": Format(".yaml", "a ROS 2 JointTrajectory", "vgtm_qp.export.trajectory", "write_ros"),
    "mjcf": Format(".xml", "a MuJoCo model", "vgtm_qp.export.mjcf", "write_mjcf"),
}
"""Every format by the name that ``vgtm export --to`` takes."""


def export_maneuver(maneuver: Result, path: str | Path, *, to: str | None = None) -> Path:
    """Write a maneuver in another form and return the path of the file.

    Parameters
    ----------
    maneuver
        What `solve` or `load_result` returned.
    path
        File to write.
    to
        Name of the format, one of `FORMATS`; by default the one that the suffix of `path` belongs to.

    Raises
    ------
    ExportError
        There is no such format, the maneuver has no such form, or the file cannot be written.
    MissingExtraError
        A package that the format needs is not installed.
    """
    path = Path(path)
    if to is None:
        named = [name for name, form in FORMATS.items() if form.suffix == path.suffix.lower()]
        if not named:
            suffixes = ", ".join(form.suffix for form in FORMATS.values())
            raise ExportError(f'no format ends in "{path.suffix}"; choices: {suffixes}')
        to = named[0]
    if to not in FORMATS:
        raise ExportError(f'no format is called "{to}"{nearest(to, FORMATS)}; choices: {", ".join(FORMATS)}')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return FORMATS[to].write(maneuver, path)
    except OSError as error:
        raise ExportError(f"{path}: cannot be written: {error.strerror or error}") from None
