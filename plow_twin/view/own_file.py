"""Picture of the first seconds of a user's file. The mapping of signals to columns determines how the file is read."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from plow_twin.record.column_guess import Guess
from plow_twin.view.figures import write_png

_SHOWN_S: Final = 10.0
_PREFIXES: Final = (("M", 1e6), ("k", 1e3))


def draw_own_file(guess: Guess, path: Path) -> Path:
    """Draw the first ten seconds as PNG. Return the path of the picture."""
    from matplotlib.figure import Figure

    load = [("excitation", name) for name in ("fx", "fy", "m")]
    largest = max(float(np.nanmax(np.abs(guess.values[key]), initial=0.0)) for key in load)
    prefix, size = next(((prefix, size) for prefix, size in _PREFIXES if largest >= size), ("", 1.0))
    shown = [
        (f"load [{prefix}N, {prefix}N m]", 1.0 / size, load),
        ("position [mm], angle [mrad]", 1e3, [("head_pose", name) for name in ("x", "y", "theta")]),
        ("speed [m/s]", 1.0, [("travel", "speed")]),
    ]
    rows = [row for row in shown if any(key in guess.values for key in row[2])]
    figure = Figure(figsize=(11, 2.8 * len(rows) + 0.6), layout="constrained")
    axes = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
    times = guess.stamps_s - np.nanmin(guess.stamps_s)
    first = times <= _SHOWN_S
    for axis, (label, factor, keys) in zip(axes, rows, strict=True):
        for key in keys:
            if key in guess.values:
                axis.plot(times[first], factor * guess.values[key][first], ".-", ms=2, lw=0.8, label=key[1])
        axis.set_ylabel(label)
        axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8)
    axes[-1].set_xlabel("time since the first row [s]")
    figure.suptitle(f"{guess.path.name}, the first ten seconds as read through the mapping")
    write_png(figure, path)
    return path
