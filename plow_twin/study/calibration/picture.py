"""Pictures of a calibration: the fit to a motion or to targets, and the near-optimal values of the unknowns."""

from __future__ import annotations

import math
from pathlib import Path
from textwrap import wrap
from typing import Any, Final

from plow_twin.estimate.result import Motion
from plow_twin.study.calibration.fit import Fit, TargetRow
from plow_twin.study.calibration.objective import RecordingObjective
from plow_twin.study.calibration.uniqueness import near_optimal_ends
from plow_twin.study.calibration.unknowns import Space, Unknown
from plow_twin.study.statistics import unit_of
from plow_twin.study.words import parameter_words
from plow_twin.view.figures import signed, write_png
from plow_twin.view.fitted import FittedPicture, FittedValue, write_fit_picture

#: Largest absolute residual on the axis; larger residuals are drawn at this value.
_MOST: Final = 5.0


def draw_motion(fit: Fit, space: Space, objective: RecordingObjective, title: str, path: Path) -> None:
    """Draw the recorded and the fitted motion as PNG, or as a rerun file if the suffix is .rrd."""
    recording = objective.recording
    model = objective.motion(fit.calibration.best.values)
    values = [_value(unknown, fit) for unknown in space.unknowns if not unknown.choices]
    meaning = "range of the search; bars: near-optimal values"
    picture = FittedPicture(
        title, Motion(recording.t, recording.q, model), values, "range", meaning, notes=_notes(fit, space)
    )
    write_fit_picture(picture, path)


def _value(unknown: Unknown, fit: Fit) -> FittedValue:
    value = fit.calibration.best.values[unknown.path]
    assert isinstance(value, float)
    low, high = near_optimal_ends(fit.clusters, unknown.path) or (value, value)
    middle = math.sqrt(unknown.low * unknown.high) if unknown.log else 0.5 * (unknown.low + unknown.high)
    label, factor = parameter_words(unknown.path)
    return FittedValue(
        label,
        (factor * value, factor * low, factor * high),
        (factor * middle, factor * unknown.low, factor * unknown.high),
        ".5g",
        is_log=unknown.log,
    )


def _notes(fit: Fit, space: Space) -> list[str]:
    calibration = fit.calibration
    before = "" if fit.before is None else f", before the fit {fit.before:.3g}"
    lines = [f"starts: {len(calibration.starts)}, objective of the best {calibration.best.objective:.3g}{before}"]
    chosen = {
        parameter_words(unknown.path)[0]: calibration.best.values[unknown.path]
        for unknown in space.unknowns
        if unknown.choices
    }
    words = [f"{name}: {value if isinstance(value, str) else signed(value, 'g')}" for name, value in chosen.items()]
    return [*lines, ", ".join(words)] if words else lines


def draw_targets(fit: Fit, space: Space, title: str, path: Path) -> None:
    """Draw the residual of each target as PNG. The colour shows whether the target is met."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 1.8 + 0.24 * len(fit.targets)), layout="constrained")
    axis: Any = figure.add_subplot()
    for row, target in enumerate(fit.targets):
        color = "tab:blue" if target.met else "tab:red"
        axis.barh(row, max(-_MOST, min(_MOST, target.residual)), color=color, height=0.6)
        axis.annotate(_got_and_asked(target), (1.01, row), xycoords=axis.get_yaxis_transform(),
                      va="center", fontsize=7, annotation_clip=False)  # fmt: skip
    axis.set_yticks(range(len(fit.targets)), [target.name for target in fit.targets], fontsize=7)
    axis.set(xlim=(-1.05 * _MOST, 1.05 * _MOST), ylim=(len(fit.targets) - 0.5, -0.5))
    axis.set_xlabel(f"residual; blue: met, red: not met; larger values are drawn at ±{_MOST:g}")
    figure.suptitle("\n".join(line for note in (title, *_notes(fit, space)) for line in wrap(note, 120)), fontsize=10)
    write_png(figure, path)


def _got_and_asked(target: TargetRow) -> str:
    unit = unit_of(target.statistic)
    factor, shown = (1e-3, " kN") if unit == "N" else (1.0, "" if unit == "1" else f" {unit}")
    got = ", ".join(signed(factor * value, ".4g") for value in target.got)
    requirement = target.asked
    if target.kind == "value" and unit == "N":
        number, _, rest = requirement.partition(" ")
        requirement = f"{signed(factor * float(number), 'g')}{shown} {rest}"
    return f"got {got}{shown}; asked {requirement}"
