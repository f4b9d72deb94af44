"""Figures as PNG files, and the parts that all of them share."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from plow_twin.errors import RecordingError
from plow_twin.record.durable import whole_file
from plow_twin.record.times import EPOCH_S

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: The sign of negative numbers as matplotlib writes it on its axes.
MINUS: Final = "\N{MINUS SIGN}"


def write_png(figure: Figure, path: Path) -> None:
    """Write a figure.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as stream:
            FigureCanvasAgg(figure).print_png(stream)  # type: ignore[no-untyped-call]
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error


def legend_beside(axis: Any, **options: Any) -> None:
    """Put the legend beside the axes: over the data it would hide some."""
    axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=7, **options)


def signed(value: float, form: str) -> str:
    """Return a number as text with a proper minus sign."""
    return f"{value:{form}}".replace("-", MINUS)


def date_text(stamp_ns: int | None) -> str:
    """Return the date of a stamp for a title; empty for a stamp that counts from its own start."""
    if stamp_ns is None or stamp_ns < EPOCH_S * 1e9:
        return ""
    return datetime.fromtimestamp(stamp_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
