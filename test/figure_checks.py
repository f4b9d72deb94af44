"""Checks of figures: legends beside the data, no overlapping or cut-off texts, and labels on all axes."""

from __future__ import annotations

from itertools import pairwise

import pytest
from matplotlib.axes import Axes
from matplotlib.backends import backend_agg
from matplotlib.figure import Figure
from matplotlib.text import Text


def kept_figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Return a list to which each figure drawn from now on is appended."""
    figures: list[Figure] = []

    class Kept(backend_agg.FigureCanvasAgg):
        def __init__(self, figure: Figure) -> None:
            figures.append(figure)
            super().__init__(figure)

    monkeypatch.setattr(backend_agg, "FigureCanvasAgg", Kept)
    return figures


def check_figure(figure: Figure) -> None:
    """Raise an AssertionError if a legend covers its axes, tick labels overlap, or a visible axis has no label."""
    backend_agg.FigureCanvasAgg(figure).draw()
    assert figure.get_suptitle()
    for axis in figure.axes:
        legend, place = axis.get_legend(), axis.get_window_extent()
        if legend is not None:
            its = legend.get_window_extent()
            assert its.x0 >= place.x1 - 1.0 or its.y1 <= place.y0 + 1.0, axis.get_ylabel()
        _check_ticks(axis)
    _check_words(figure)
    for text in _texts(figure):
        assert "um" not in text.split() and "[um]" not in text
        assert not (text[:1] == "-" and text[1:2].isdigit()), f"{text}: a hyphen for a minus sign"


def _check_words(figure: Figure) -> None:
    """Raise an AssertionError if titles and labels of axes overlap or extend beyond the figure."""
    words = [word for axis in figure.axes for word in (axis.title, axis.xaxis.label, axis.yaxis.label)]
    words += [text for text in figure.texts if text.get_text()]
    boxes = [(word.get_text(), word.get_window_extent()) for word in words if word.get_text() and word.get_visible()]
    whole = figure.bbox.padded(1.0)
    for number, (text, box) in enumerate(boxes):
        assert whole.x0 <= box.x0 and box.x1 <= whole.x1 and whole.y0 <= box.y0 and box.y1 <= whole.y1, text
        for other, its in boxes[number + 1 :]:
            apart = max(box.x0 - its.x1, its.x0 - box.x1, box.y0 - its.y1, its.y0 - box.y1)
            assert apart > 0.0, (text, other)


def _check_ticks(axis: Axes) -> None:
    for labels, low, high in (
        (axis.get_xticklabels(), "x0", "x1"),
        (axis.get_yticklabels(), "y0", "y1"),
    ):
        shown = [label.get_window_extent() for label in labels if label.get_visible() and label.get_text()]
        for one, other in pairwise(shown):
            first, second = sorted((one, other), key=lambda box: getattr(box, low))
            assert getattr(first, high) <= getattr(second, low) + 1.0, [label.get_text() for label in labels]


def _texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(Text) if text.get_visible()]
