"""Functions that all figures share: PNG files, legends, numbers and dates."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from plow_twin.errors import RecordingError
from plow_twin.record.durable import whole_file
from plow_twin.record.times import EPOCH_S

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from plow_twin.record.reader import RunReader

MINUS: Final = "\N{MINUS SIGN}"


def write_png(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG file. Raise `RecordingError` if the file cannot be written."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as stream:
            FigureCanvasAgg(figure).print_png(stream)  # type: ignore[no-untyped-call]
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error


def legend_beside(axis: Any, **options: Any) -> None:
    """Put the legend beside the axes, where it hides no data."""
    axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=7, **options)


def signed(value: float, form: str) -> str:
    """Format a number with a typographic minus sign, as matplotlib does on axes."""
    return f"{value:{form}}".replace("-", MINUS)


def scene_and_date(reader: RunReader, first_ns: int | None = None) -> str:
    """Return the scene and the date of a recording for a title; `first_ns` is the first stamp if it is known."""
    scene = reader.header.parameters.get("scene")
    parts = [f"scene {Path(scene).name}"] if isinstance(scene, str) and scene else []
    date = date_text(reader.began_ns() if first_ns is None else first_ns)
    return ", ".join([*parts, date or f"file of {date_text(reader.path.stat().st_mtime_ns)}"])


def date_text(stamp_ns: int | None) -> str:
    """Return the date of a stamp, or an empty text if the stamp does not count from 1970."""
    if stamp_ns is None or stamp_ns < EPOCH_S * 1e9:
        return ""
    return datetime.fromtimestamp(stamp_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
