"""`Maneuver`, the result of `solve`, which can be plotted."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from vgtm_qp.result.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class Maneuver(Result):
    """A :class:`~vgtm_qp.result.result.Result` with its plots; matplotlib is imported by the first of them."""

    def plot(self, **options: Any) -> Figure:
        """Return a figure of states side by side; see `vgtm_qp.view.figure.plot_frames` for the options."""
        from vgtm_qp.view.figure import plot_frames

        return plot_frames(self, **options)

    def plot_clearance(self, *, axes: Axes | None = None) -> Figure:
        """Plot the least distances to obstacles and between members over time."""
        return self._plot("clearance", axes)

    def plot_strokes(self, *, axes: Axes | None = None) -> Figure:
        """Plot the lengths of the actuated members over time, between their limits."""
        return self._plot("strokes", axes)

    def plot_tip_error(self, *, axes: Axes | None = None) -> Figure:
        """Plot the distance of the tip from its target over time."""
        return self._plot("tip error", axes)

    def plot_tracking_gap(self, *, axes: Axes | None = None) -> Figure:
        """Plot the greatest distance of a station from its node of the reference curve over time."""
        return self._plot("tracking gap", axes)

    def plot_step_time(self, *, axes: Axes | None = None) -> Figure:
        """Plot the computing time of each step by phase."""
        return self._plot("step time", axes)

    def _plot(self, quantity: str, axes: Axes | None) -> Figure:
        from vgtm_qp.view.plots import plot

        return plot(quantity, self, axes)


def load_result(path: str | Path) -> Maneuver:
    """Read a result file, without pickle, and check all of it.

    Raises
    ------
    ResultError
        There is no such file, it is cut or altered, of another version, or an array is missing or malformed.
    """
    return Maneuver.load(path)
