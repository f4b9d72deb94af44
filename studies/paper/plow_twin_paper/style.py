"""Style of the report's figures. The colours can be distinguished by colour-blind readers (Okabe and Ito)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from plow_twin.record.durable import whole_file
from plow_twin_paper.values import Sense

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CORNER_STYLE: Final = {"a": ("#0072B2", "o"), "b": ("#D55E00", "s"), "c": ("#009E73", "^"), "d": ("#CC79A7", "D")}
FACE_STYLE: Final = {
    "top": ("#D55E00", "s"), "right": ("#0072B2", "o"), "bottom": ("#CC79A7", "D"), "left": ("#009E73", "^"),
}  # fmt: skip
SENSE_COLOR: Final[dict[Sense, str]] = {"ccw": "#0072B2", "cw": "#D55E00"}
DARK: Final = "#333333"
LIGHT: Final = "#B0B0B0"
_SETTINGS: Final[Any] = {
    "font.size": 9.5,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "lines.linewidth": 1.1,
}
_DPI: Final = 130


@contextmanager
def sheet(width: float, height: float) -> Iterator[Figure]:
    """Yield an empty figure of the given size [inch] in the style of the report."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(_SETTINGS):
        yield Figure(figsize=(width, height), layout="constrained")


def save(figure: Figure, path: Path, heading: str, scene: str) -> None:
    """Write a figure as PNG. Heading, scene and date are added above its title."""
    title = f"{heading}; scene {scene}, {datetime.now(UTC):%Y-%m-%d}"
    figure.suptitle("\n".join(filter(None, (title, figure.get_suptitle()))), fontsize=10)
    with whole_file(path) as stream:
        figure.savefig(stream, dpi=_DPI, facecolor="white", format="png", metadata={"Title": title})
