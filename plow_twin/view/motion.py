"""Figure of a simulated motion."""

from __future__ import annotations

import io
from typing import Any

from matplotlib.figure import Figure

from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.run.simulate import Result
from plow_twin.view.figures import legend_beside
from plow_twin.view.section import PAIR_RGB


class NotebookFigure(Figure):
    """A figure that a notebook displays without the global state of pyplot."""

    def _repr_png_(self) -> bytes:
        stream = io.BytesIO()
        self.savefig(stream, format="png")
        return stream.getvalue()


def plot_motion(result: Result, title: str = "") -> Figure:
    """Draw the pose and the contact forces over time.

    This function needs matplotlib (extra `view` or `study`).

    Parameters
    ----------
    result : Result
        The motion that `simulate` returned.
    title : str
        Title of the figure. The default title contains the length of the motion and the number of contact changes.

    Returns
    -------
    matplotlib.figure.Figure
        The figure. Notebooks display it, and its method `savefig` writes it to a file.
    """
    figure = NotebookFigure(figsize=(11.0, 7.5), layout="constrained")
    position, angle, force = (axes := figure.subplots(3, 1, sharex=True, height_ratios=(2, 1, 2)))
    for place, name in enumerate(("x", "y")):
        position.plot(result.t, 1e3 * result.q[:, place], lw=0.9, label=name)
    position.set_ylabel("position [mm]")
    angle.plot(result.t, 1e3 * result.q[:, 2], lw=0.9, color="tab:green", label="θ")
    angle.set_ylabel("angle [mrad]")
    _forces(force, result)
    for axis in axes:
        legend_beside(axis)
    force.set_xlabel("time [s]")
    duration = float(result.t[-1]) if len(result.t) else 0.0
    figure.suptitle(title or f"{duration:g} s of motion, {len(result.events)} changes of contact")
    return figure


def _forces(axis: Any, result: Result) -> None:
    for pair, name in enumerate(PAIR_NAMES):
        axis.plot(result.t, result.force[:, pair] / 1e3, lw=0.9, color=PAIR_RGB[pair], label=name)
    axis.set_ylim(bottom=0.0)
    axis.set_ylabel("contact force [kN]")
