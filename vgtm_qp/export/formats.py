"""The formats by name, and the one function that writes any of them."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vgtm_qp.errors import ExportError, nearest
from vgtm_qp.result.file import replacing

if TYPE_CHECKING:
    from vgtm_qp.result.result import Result


class Format(NamedTuple):
    """One form of a maneuver: suffix of its files, module in this folder, and the function for the content.

    The module is imported when the format is written.
    """

    suffix: str
    module: str
    function: str
    is_slow: bool = False
    """Whether the function draws many frames, and tells the share that is done."""
    describe: str = ""
    """Function that describes the file in another one beside it, by maneuver and path."""

    def content(self, maneuver: Result, progress: Callable[[float], None] | None = None) -> bytes:
        """Return what a file of a maneuver holds; a slow format calls `progress` with the share that is done."""
        function = getattr(import_module(f"vgtm_qp.export.{self.module}"), self.function)
        content: bytes | str = function(maneuver, progress) if self.is_slow else function(maneuver)
        return content.encode() if isinstance(content, str) else content


FORMATS = {
    "html": Format(".html", "html", "html_text", is_slow=True),
    "gif": Format(".gif", "pictures", "gif", is_slow=True),
    "mp4": Format(".mp4", "pictures", "mp4", is_slow=True),
    "pdf": Format(".pdf", "pictures", "pdf"),
    "png": Format(".png", "pictures", "png"),
    "csv": Format(".csv", "trajectory", "csv_text"),
    "mcap": Format(".mcap", "trajectory", "mcap_bytes", describe="describe_bag"),
    "ros": Format(".yaml", "trajectory", "ros_text"),
    "mjcf": Format(".xml", "mjcf", "mjcf"),
}
"""Every format by the name that ``vgtm export --to`` takes."""


def export_maneuver(
    maneuver: Result,
    path: str | Path,
    *,
    to: str | None = None,
    progress: Callable[[float], None] | None = None,
) -> Path:
    """Write a maneuver in another form and return the file's path; an error leaves an old file as it was.

    A ROS 2 bag gets its ``metadata.yaml`` beside it, unless the folder has one that is about other files.

    Parameters
    ----------
    maneuver
        What `solve` or `load_result` returned.
    path
        File to write.
    to
        Name of the format, one of `FORMATS`; by default that of the suffix of `path`.
    progress
        Called with the share that is done, 0 to 1, after each frame of a page, an animation or a video.

    Raises
    ------
    ExportError
        There is no such format, the maneuver cannot have that form, or the file cannot be written.
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
    form = FORMATS[to]
    if form.module == "pictures" and path.suffix.lower() != form.suffix:
        raise ExportError(f'{path}: a {to} cannot be "{path.suffix}"; choices: {form.suffix}')
    with replacing(path, ExportError) as scratch:
        scratch.write_bytes(form.content(maneuver, progress))
    if form.describe:
        getattr(import_module(f"vgtm_qp.export.{form.module}"), form.describe)(maneuver, path)
    return path
