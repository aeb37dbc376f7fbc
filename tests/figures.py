"""What is written in a figure, and where: nothing is clipped and nothing lies upon anything else."""

from __future__ import annotations

from itertools import combinations

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


def clipped_and_overlapping(figure: Figure) -> tuple[list[str], list[tuple[str, str]]]:
    """Return the texts that leave a figure, and the pairs of texts that lie upon one another."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    texts = [*figure.texts, *(text for legend in figure.legends for text in legend.get_texts())]
    for axes in figure.axes:
        names = [axes.xaxis.label, axes.yaxis.label] if axes.axison else []
        legend = axes.get_legend()
        texts += [*axes.texts, axes.title, *names, *(legend.get_texts() if legend else [])]
    boxes = [
        (text.get_text(), text.get_window_extent(renderer).padded(-1.0))
        for text in texts
        if text.get_text().strip()
    ]
    whole = figure.bbox
    clipped = [
        words
        for words, box in boxes
        if box.x0 < whole.x0 or box.y0 < whole.y0 or box.x1 > whole.x1 or box.y1 > whole.y1
    ]
    pairs = [(one, other) for (one, a), (other, b) in combinations(boxes, 2) if a.overlaps(b)]
    return clipped, pairs
