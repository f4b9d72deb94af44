"""Picture of a fit, as a PNG file or a rerun file.

The picture shows measured and fitted motion, residuals, and fitted values with their intervals and priors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate.result import Motion
from plow_twin.view.figures import legend_beside, signed, write_png

Array = NDArray[np.float64]

#: Factor from m and rad to mm and mrad.
_SCALE: Final = 1e3
_COMPONENTS: Final = (("x", "mm"), ("y", "mm"), ("theta", "mrad"))
_MEASURED: Final = (150, 155, 165)
_FITTED: Final = (86, 180, 233)
_RESIDUAL: Final = (240, 160, 60)
_LINE: Final = 150
#: Steps that exceed the median step by more than this factor are drawn as gaps.
_GAP: Final = 10.0
#: Largest drawn distance of a value from the middle of its prior, in half widths of the prior.
_FARTHEST: Final = 2.0


@dataclass(frozen=True)
class FittedValue:
    """A fitted value and its prior. Value and prior are triples (middle, low, high) in the unit of the label.

    `note` is the state of the value, or a short remark. `is_log` selects a logarithmic scale.
    """

    label: str
    value: tuple[float, float, float]
    prior: tuple[float, float, float] | None
    digits: str = ".4g"
    note: str = ""
    is_log: bool = False

    @property
    def text(self) -> str:
        """The value and its interval."""
        middle, low, high = (signed(number, self.digits) for number in self.value)
        interval = "" if low == middle == high else f" ({low} to {high})"
        return f"{middle}{interval}{', ' if self.note else ''}{self.note}"

    @property
    def prior_text(self) -> str:
        """The interval of the prior, or an empty text."""
        if self.prior is None:
            return ""
        return " to ".join(signed(number, self.digits) for number in self.prior[1:])

    def places(self) -> Array:
        """Return value, low and high on a scale with -1, 0 and 1 at low, middle and high of the prior, shape (3,)."""
        if self.prior is None:
            return np.full(3, np.nan)
        scale = np.log if self.is_log else np.asarray
        middle, low, high = scale(self.prior)
        off = scale(self.value) - middle
        return np.asarray(np.where(off < 0.0, off / max(middle - low, 1e-300), off / max(high - middle, 1e-300)))


@dataclass(frozen=True)
class FittedPicture:
    """Content of the picture of a fit.

    `noise` contains the standard deviations of the measured x, y [m] and theta [rad]. `prior_name` is the label of the
    prior beside each value, and `prior_meaning` explains the grey bars.
    """

    title: str
    motion: Motion
    values: Sequence[FittedValue]
    prior_name: str
    prior_meaning: str
    noise: tuple[float, float, float] | None = None
    notes: Sequence[str] = ()

    def figure(self) -> Any:
        """Return the matplotlib figure."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(16, 9.5), layout="constrained")
        grid = figure.add_gridspec(6, 2, width_ratios=(5, 3), height_ratios=(2, 1) * 3)
        above = None
        for number in range(len(_COMPONENTS)):
            above = figure.add_subplot(grid[2 * number, 0], sharex=above)
            below = figure.add_subplot(grid[2 * number + 1, 0], sharex=above)
            self._component(number, above, below)
            above.tick_params(labelbottom=False)
            below.tick_params(labelbottom=number == len(_COMPONENTS) - 1)
        below.set_xlabel("time [s]")
        self._values(figure.add_subplot(grid[:, 1]))
        lines = (line for note in (self.title, *self.notes) for line in wrap(note, _LINE))
        figure.suptitle("\n".join(lines), fontsize=11)
        figure.align_ylabels()
        return figure

    def _component(self, number: int, above: Any, below: Any) -> None:
        name, unit = _COMPONENTS[number]
        motion = self.motion
        measured, model, residual = (
            _SCALE * rows[:, number] for rows in (motion.measured, motion.model, motion.residual)
        )
        above.plot(motion.t, measured, ".", ms=2.5, color="0.55", label="measured")
        if np.isfinite(model).any():
            above.plot(*_broken(motion.t, model), lw=1.0, color="tab:blue", label="fitted")
        else:
            above.plot([], [], color="tab:blue", label="no fitted motion")
        above.set_ylabel(f"{name.replace('theta', 'θ')} [{unit}]")
        legend_beside(above)
        below.set_ylabel(f"residual\n[{unit}]")
        if not np.isfinite(residual).any():
            missing = "not measured" if np.isfinite(model).any() else "no fit"
            below.text(0.5, 0.5, missing, transform=below.transAxes, ha="center", va="center", color="0.4")
            below.set_yticks([])
            return
        below.plot(motion.t, residual, ".", ms=1.5, color="tab:red", label="measured − fitted")
        below.axhline(0.0, color="0.4", lw=0.6)
        if self.noise is not None:
            half = 1.645 * _SCALE * self.noise[number]
            below.axhspan(-half, half, color="0.88", lw=0.0, zorder=0, label="90 % of the\nsensor's noise")
        legend_beside(below)

    def _values(self, axis: Any) -> None:
        rows = range(len(self.values))
        axis.axvspan(-1.0, 1.0, color="0.9", lw=0.0, zorder=0)
        for row, value in zip(rows, self.values, strict=True):
            middle, low, high = np.clip(value.places(), -_FARTHEST, _FARTHEST)
            axis.plot([low, high], [row, row], color="tab:blue", lw=2.5, solid_capstyle="butt")
            axis.plot(middle, row, "o", ms=5, color="tab:blue")
            words = value.text + (f"\n{self.prior_name} {value.prior_text}" if value.prior_text else "")
            axis.annotate(words, (1.02, row), xycoords=axis.get_yaxis_transform(), va="center", fontsize=8,
                          annotation_clip=False)  # fmt: skip
        axis.set_yticks(list(rows), [value.label for value in self.values])
        axis.set(ylim=(len(self.values) - 0.5, -0.5), xlim=(-_FARTHEST - 0.2, _FARTHEST + 0.2))
        axis.set_xticks([-1.0, 0.0, 1.0], ["low", "middle", "high"])
        axis.set_xlabel(f"grey: {self.prior_meaning}")
        axis.grid(axis="y", color="0.93")
        axis.set_title("Values with their intervals", fontsize=10)


def _broken(t: Array, values: Array) -> tuple[Array, Array]:
    finite = np.isfinite(values)
    t, values = t[finite], values[finite]
    steps = np.diff(t)
    gaps = np.flatnonzero(steps > _GAP * np.median(steps)) + 1 if len(steps) else np.zeros(0, np.int64)
    return np.insert(t, gaps, np.nan), np.insert(values, gaps, np.nan)


def markdown(picture: FittedPicture) -> str:
    """Return title, notes and values as Markdown."""
    rows = [f"| {value.label} | {value.text} | {value.prior_text} |" for value in picture.values]
    heads = f"| | fitted | {picture.prior_name} |", "|---|---|---|"
    return "\n".join((f"# {picture.title}", "", "\n\n".join(picture.notes), "", *heads, *rows, ""))


def write_fit_picture(picture: FittedPicture, path: Path) -> None:
    """Write a PNG file, or a rerun file if the suffix is .rrd. Raise `RecordingError` if the file cannot be written."""
    if path.suffix == ".rrd":
        _write_rrd(picture, path)
    else:
        write_png(picture.figure(), path)


def _write_rrd(picture: FittedPicture, path: Path) -> None:
    import rerun as rr
    import rerun.blueprint as rrb

    from plow_twin.view.columns import RUN_TIME
    from plow_twin.view.rrd_file import RrdFile

    stream = rr.RecordingStream("plow_twin")
    plots = [
        rrb.TimeSeriesView(origin=f"{kind}/{name}", name=f"{title} {name} [{unit}]")
        for name, unit in _COMPONENTS
        for kind, title in (("pose", "Measured and fitted"), ("residual", "Measured minus fitted"))
    ]
    layout = rrb.Horizontal(
        rrb.Vertical(*plots, row_shares=[2, 1] * len(_COMPONENTS)),
        rrb.TextDocumentView(origin="values", name="Values"),
        column_shares=[3, 2],
    )
    panels = rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed")
    with RrdFile(path) as file:
        file.attach(stream, rrb.Blueprint(layout, rrb.TimePanel(state="collapsed", timeline=RUN_TIME), *panels))
        motion = picture.motion
        for number, (name, _) in enumerate(_COMPONENTS):
            points = rr.SeriesPoints(colors=[_MEASURED], names=["measured"], marker_sizes=[1.5])
            stream.log(f"pose/{name}/measured", points, static=True)
            stream.log(f"pose/{name}/fitted", rr.SeriesLines(colors=[_FITTED], names=["fitted"]), static=True)
            stream.log(f"residual/{name}", rr.SeriesPoints(colors=[_RESIDUAL], marker_sizes=[1.5]), static=True)
            curves = {
                f"pose/{name}/measured": motion.measured,
                f"pose/{name}/fitted": motion.model,
                f"residual/{name}": motion.residual,
            }
            for entity, rows in curves.items():
                finite = np.isfinite(rows[:, number])
                times = rr.TimeColumn(RUN_TIME, duration=motion.t[finite])
                values = rr.Scalars.columns(scalars=_SCALE * rows[finite, number])
                rr.send_columns(entity, [times], values, recording=stream)
        document = rr.TextDocument(markdown(picture), media_type=rr.MediaType.MARKDOWN)
        stream.log("values", document, static=True)
