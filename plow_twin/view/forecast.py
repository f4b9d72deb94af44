"""Picture of a forecast. It shows the clearances over time, and the probability that a limit has been reached."""

from __future__ import annotations

from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import numpy as np

from plow_twin.view.figures import legend_beside, write_png

if TYPE_CHECKING:
    from plow_twin.estimate.forecast import Forecast

_MOMENTS = 120
_COLOURS = ("#1f4e9c", "#d62728")


def draw_forecast(forecast: Forecast, path: FilePath, title: str) -> None:
    """Draw a PNG with P10, P50 and P90 of both clearances over time, and the probability that a limit is reached."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 4.8), layout="constrained", dpi=110)
    figure.suptitle(title, fontsize=11)
    left, right = figure.subplots(1, 2)
    plan = forecast.plan
    reached = forecast.hours[np.isfinite(forecast.hours)]
    # if the limits have already been reached, the whole horizon is shown
    last = 1.3 * float(np.quantile(reached, 0.95)) if len(reached) else 0.0
    end = min(plan.horizon_h, last) if last > 0.0 else plan.horizon_h
    hours = np.linspace(0.0, end, _MOMENTS)
    growing = 1e3 * forecast.clearances(hours)
    limits = (plan.limit_horizontal_m, plan.limit_vertical_m)
    for axis, (name, limit, colour) in enumerate(zip(("horizontal", "vertical"), limits, _COLOURS, strict=True)):
        low, middle, high = np.minimum(growing[:, :, axis], 1e3 * limit)
        left.fill_between(hours, low, high, color=colour, alpha=0.2, linewidth=0.0)
        until = hours <= (forecast.quantile(0.5) or end)
        left.plot(hours[until], middle[until], color=colour, label=f"{name}: P50,\nshaded P10 to P90")
        left.axhline(1e3 * limit, color=colour, linestyle="--", linewidth=1.0, label=f"its limit, {1e3 * limit:g} mm")
    left.set(xlabel="hours of operation", ylabel="clearance [mm]", title="Until a limit is reached", xlim=(0.0, end))
    legend_beside(left)
    share = np.searchsorted(np.sort(forecast.hours), hours, side="right") / len(forecast.hours)
    right.plot(hours, 100.0 * share, color="black")
    for name, quantile in (("P10", 0.1), ("P50", 0.5), ("P90", 0.9)):
        at = forecast.quantile(quantile)
        if at is not None and at <= end:
            right.plot([at, at], [0.0, 100.0 * quantile], color="grey", linewidth=1.0)
            side, offset = ("right", -4.0) if at > 0.8 * end else ("left", 4.0)
            right.annotate(
                f"{name} {at:.4g} h",
                (at, 100.0 * quantile),
                xytext=(offset, -10.0),
                textcoords="offset points",
                ha=side,
                # a white box hides the line behind the label
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0},
            )
    if plan.stop_h is not None and plan.stop_h <= end:
        right.axvline(plan.stop_h, color="#1b7837", linestyle=":", label="planned stop")
        legend_beside(right)
    missed = 100.0 * float(np.mean(~np.isfinite(forecast.hours)))
    right.set(xlabel="hours of operation", ylabel="probability that a limit is reached [%]", xlim=(0.0, end))
    right.set(ylim=(0.0, 102.0), title=f"Not reached in {plan.horizon_h:g} h: {missed:.0f} %")
    write_png(figure, path)
