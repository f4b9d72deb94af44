"""A year in the life of a head, from new pads to the limit: monthly estimates of the clearance, and a forecast.

The sensor of the head is synthetic: it measures the poses of the simulated machine with noise, bias and delay.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from plow_twin import Table, Wear, load_scene, simulate
from plow_twin.estimate.coefficient import History, coefficient
from plow_twin.estimate.estimate import estimate
from plow_twin.estimate.forecast import Plan, forecast, with_clearances
from plow_twin.estimate.life import wear_path
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.result import State
from plow_twin.model.loads import compile_loads

DAYS, DAY_M, VISITS = 365.0, 15e3, 12
GROWTH_M, SPEED_M_S = 6e-3, 2.0
NOISE, BIAS, DELAY_S = np.array([5e-4, 5e-4, 2e-3]), np.array([1e-3, -5e-4, 2e-3]), 0.02

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples/a_year")
out.mkdir(parents=True, exist_ok=True)
rng = np.random.default_rng(1)

# the assumed machine: its load has an error of a few per cent, and its wear coefficient is known to a factor of ten
believed = replace(load_scene("paper"), wear=Wear(1e-15, 0.06, SPEED_M_S, prior_m2_n=(3e-16, 3e-15)))
assert believed.wear is not None
limits = believed.clearance.horizontal_m + GROWTH_M, believed.clearance.vertical_m + GROWTH_M
t = np.arange(0.0, 6.0 * np.pi, 0.01)
load = compile_loads(believed.loads).at(t)
true_load = load * (1.0 + 0.04 * rng.standard_normal(3))
path = wear_path(replace(believed, loads=(Table("true", t, true_load),)), limits, np.inf)
grown = path.clearance_growth()
# with this wear coefficient, a clearance reaches its limit at the end of the year
reached = min(float(np.interp(GROWTH_M, column, path.exposure, right=np.inf)) for column in grown.T)
k_s = reached * believed.wear.pad_area_m2 / (DAYS * DAY_M)


def visit(day: float) -> tuple[np.ndarray, Poses]:
    """Return the true clearances on a day, and the poses that the sensor measures over a few load periods."""
    exposure = k_s * day * DAY_M / believed.wear.pad_area_m2
    depth = [float(np.interp(exposure, path.exposure, column)) for column in path.depth.T]
    worn = replace(
        believed,
        loads=(Table("true", t, true_load),),
        wear=replace(believed.wear, coefficient_m2_n=0.0, initial_depth_m=tuple(depth)),
    )
    motion = simulate(worn, t_end=float(t[-1]) - 0.1, output_dt=0.02)
    measured = motion.q + BIAS + NOISE * rng.standard_normal(motion.q.shape)
    poses, _ = Poses.of(motion.t + DELAY_S, measured)
    true = [float(np.interp(exposure, path.exposure, column)) for column in grown.T]
    return np.array([believed.clearance.horizontal_m, believed.clearance.vertical_m]) + true, poses


stream = rr.RecordingStream("plow_twin_year")
names = ("horizontal", "vertical")
titles = {f"clearance/{name}": f"{name} clearance [mm]: truth, estimate, 90 %, limit" for name in names}
titles |= {
    "limit_reached": "day on which the limit is reached: truth, P10, P50, P90",
    "coefficient": "wear coefficient [1e-15 m^2/N]: truth, estimate, 90 %",
}
edges = (rr.TimeRangeBoundary.absolute(seq=day) for day in (0, round(DAYS)))
whole = rrb.archetypes.TimeAxis(view_range=rr.TimeRange(*edges))
views = [rrb.TimeSeriesView(origin=entity, name=title, axis_x=whole) for entity, title in titles.items()]
panel = rrb.TimePanel(state="collapsed", timeline="day", play_state="paused")
blueprint = rrb.Blueprint(rrb.Grid(*views, grid_columns=2), panel, collapse_panels=True)
stream.save(out / "year.rrd", default_blueprint=blueprint)
colors = {
    "truth": (240, 240, 240), "limit": (220, 60, 60), "estimate": (240, 160, 60), "p50": (240, 160, 60),
    **dict.fromkeys(("p05", "p95", "p10", "p90"), (90, 140, 200)),
}  # fmt: skip
for entity in titles:
    for name, color in colors.items():
        stream.log(f"{entity}/{name}", rr.SeriesLines(colors=color, names=name), static=True)


def show(day: float, entity: str, **values: float | None) -> None:
    """Draw numbers of a day. Numbers that are None are skipped."""
    stream.set_time("day", sequence=round(day))
    for name, value in values.items():
        if value is not None:
            stream.log(f"{entity}/{name}", rr.Scalars(value))


history: list[tuple[float, np.ndarray, np.ndarray]] = []
widths = []
for day in np.linspace(0.0, DAYS, VISITS, endpoint=False):
    true, poses = visit(float(day))
    found = estimate(believed, Load.of(t, load)[0], poses)
    for name, value, state, truth, limit in zip(
        names,
        (found.horizontal, found.vertical),
        (found.horizontal_state, found.vertical_state),
        true,
        limits,
        strict=True,
    ):
        show(day, f"clearance/{name}", truth=1e3 * truth, limit=1e3 * limit)
        if state is State.ESTIMATED:
            show(day, f"clearance/{name}", estimate=1e3 * value.mean, p05=1e3 * value.p05, p95=1e3 * value.p95)
    print(
        f"day {day:3.0f}: {names[0]} {1e3 * true[0]:.2f} mm, estimated {1e3 * found.horizontal.mean:.2f} "
        f"({1e3 * found.horizontal.p05:.2f} .. {1e3 * found.horizontal.p95:.2f}) {found.horizontal_state.value}",
        flush=True,
    )
    if State.WITHDRAWN in (found.horizontal_state, found.vertical_state):
        print("  " + "; ".join(found.reasons))
        continue
    # an error of the frame is equal at all visits, so the growth of the clearance is as certain as the apparent
    # clearance
    seen = found.in_scene_frame()
    mean, deviation = (np.array([getattr(value, name) for value in seen]) for name in ("mean", "deviation"))
    history.append((float(day), mean, deviation))
    if len(history) < 2:
        continue
    days, means, deviations = (np.array(column) for column in zip(*history, strict=True))
    known = coefficient(believed, History(days * DAY_M, means, deviations))
    interval = known.interval()
    now = with_clearances(believed, *map(float, known.clearance), known.depth)
    plan = Plan(*limits, horizon_h=4.0 * DAYS * DAY_M / SPEED_M_S / 3600.0)
    ahead = forecast(now, plan, (float(known.deviation[0]), float(known.deviation[1])), known)
    at = [
        None if hours is None else float(day) + hours * 3600.0 * SPEED_M_S / DAY_M
        for hours in map(ahead.quantile, (0.1, 0.5, 0.9))
    ]
    show(day, "limit_reached", truth=DAYS, p10=at[0], p50=at[1], p90=at[2])
    told = {"estimate": interval.mean, "p05": interval.p05, "p95": interval.p95, "truth": k_s}
    show(day, "coefficient", **{name: 1e15 * value for name, value in told.items()})
    if at[0] is not None and at[2] is not None:
        widths.append(at[2] - at[0])
        print(f"  the limit is reached on day {at[0]:.0f} .. {at[2]:.0f} (P10, P90), in truth {DAYS:.0f}")
stream.flush()
print(
    f"the forecast narrowed from {widths[0]:.0f} to {widths[-1]:.0f} days; plow-twin's view: rerun {out / 'year.rrd'}"
)
assert widths[-1] < 0.3 * widths[0]
