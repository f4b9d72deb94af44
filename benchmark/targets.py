"""Targets of the solver, and whether a run of the benchmark reaches them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from cases import Row
from ensemble_rows import LISTED, PAIRS, batch_row, core_row
from levels import PEERS, fastest
from random_rows import AMPLIFIES
from work_precision import OURS, OURS_BARE
from workloads import HOUR_S


@dataclass(frozen=True)
class Verdict:
    """One row of the table of targets."""

    work: str
    measured: str
    wanted: str
    reached: bool


@dataclass(frozen=True)
class Ratio:
    """A target: to be `times` as fast as a group of peers at equal error."""

    scene: str
    output_s: float
    level: float
    peer: str
    times: float


RATIOS = (
    Ratio("kv", 0.1, 1e-6, "CVODE from C", 30.0),
    Ratio("kv", 0.1, 1e-6, "CVODE from C, rootfinding", 30.0),
    Ratio("kv", 0.1, 1e-6, "best of SciPy and scikit-sundae", 90.0),
    Ratio("kv", 0.1, 1e-6, "heyoka", 10.0),
    Ratio("kv", 0.1, 1e-9, "heyoka", 10.0),
    Ratio("kv", 1e-3, 1e-6, "heyoka", 10.0),
    Ratio("kv", 1e-3, 1e-9, "heyoka", 10.0),
    Ratio("hc", 0.1, 1e-6, "heyoka", 10.0),
    Ratio("hc", 0.1, 1e-9, "heyoka", 10.0),
    Ratio("hc", 1e-3, 1e-6, "heyoka", 10.0),
    Ratio("hc", 1e-3, 1e-9, "heyoka", 10.0),
    Ratio("kv", 1e-3, 1e-6, "CVODE from C", 20.0),
    Ratio("kv", 1e-3, 1e-6, "CVODE from C, rootfinding", 20.0),
    Ratio("kv", 0.1, 1e-9, "CVODE from C", 60.0),
    Ratio("kv", 0.1, 1e-9, "CVODE from C, rootfinding", 60.0),
    Ratio("kv", 1e-3, 1e-9, "CVODE from C", 60.0),
    Ratio("kv", 1e-3, 1e-9, "CVODE from C, rootfinding", 60.0),
    Ratio("hc", 0.1, 1e-6, "lean jitted RK4", 10.0),
    Ratio("hc", 1e-3, 1e-6, "lean jitted RK4", 10.0),
    Ratio("hc", 0.1, 1e-9, "lean jitted RK4", 40.0),
    Ratio("hc", 1e-3, 1e-9, "lean jitted RK4", 40.0),
    Ratio("kv", 1e-3, 1e-3, "best multibody engine", 150.0),
)
ENSEMBLE_S, WITHIN, REAL_TIME, CORE_SHARE = 0.5, 10.0, 1000.0, 0.25
BATCH_TIMES = 5.0
#: Largest run time of an hour almost without events, relative to an hour of the driven scene.
IDLE_SHARE = 0.01


def verdicts(rows: Sequence[Row]) -> Iterator[Verdict]:
    for ratio in RATIOS:
        yield from _of_ratio(rows, ratio)
    yield from _of_ensemble(rows)
    yield from _of_random_scenes(rows)
    yield from _of_sampled_load(rows)
    yield from _of_idle_time(rows)


def _of_ratio(rows: Sequence[Row], ratio: Ratio) -> Iterator[Verdict]:
    where = rows, ratio.scene, ratio.output_s, ratio.level
    bare, full = (fastest(*where, name.__eq__) for name in (OURS_BARE, OURS))
    peer = fastest(*where, PEERS[ratio.peer])
    output = "0.1 s" if ratio.output_s == 0.1 else "1 ms"
    work = f"{ratio.scene.upper()}, 20 s, output each {output}, error {ratio.level:g}, against {ratio.peer}"
    target_text = f"{ratio.times:g}x"
    if bare is None:
        return
    if peer is not None:
        times = peer.wall_ms / bare.wall_ms
        also = "" if full is None else f", {peer.wall_ms / full.wall_ms:.3g}x with forces and penetrations"
        measured = f"{bare.wall_ms:.3g} ms against {peer.wall_ms:.4g} ms of {peer.solver}: **{times:.3g}x**{also}"
        yield Verdict(work, measured, target_text, times >= ratio.times)
    elif any(PEERS[ratio.peer](row.solver) and row.wall_ms is not None for row in rows):
        yield Verdict(work, f"{bare.wall_ms:.3g} ms; no setting of the peer reaches the error", target_text, True)


def _of_ensemble(rows: Sequence[Row]) -> Iterator[Verdict]:
    row = core_row(rows)
    if row is not None and row.wall_ms is not None and row.error is not None:
        measured = f"{1e-3 * row.wall_ms:.2f} s at {row.setting}, worst error {row.error:.2g}"
        target_text = f"{ENSEMBLE_S:g} s on one core, every pair within {LISTED:g}"
        reached = row.wall_ms <= 1e3 * ENSEMBLE_S and row.error <= LISTED and row.scene == PAIRS
        yield Verdict(row.scene + ", 20 s", measured, target_text, reached)
        batch = batch_row(rows)
        if batch is not None and batch.wall_ms is not None:
            times = batch.wall_ms / row.wall_ms
            measured = (
                f"{1e-3 * row.wall_ms:.2f} s against {1e-3 * batch.wall_ms:.2f} s at {batch.setting}: **{times:.3g}x**"
            )
            work = f"{row.scene}, 20 s, against heyoka in batches"
            yield Verdict(work, measured, f"{BATCH_TIMES:g}x", times >= BATCH_TIMES)


def _of_random_scenes(rows: Sequence[Row]) -> Iterator[Verdict]:
    picked = [row for row in rows if row.section == "random_scenes"]
    for tol in dict.fromkeys(row.setting for row in picked):
        at_tol = [row for row in picked if row.setting == tol]
        failed = sum(row.status.startswith("failed") for row in at_tol)
        calm = [row.value or 0.0 for row in at_tol if row.status == "ok" and (row.amplification or 0.0) < AMPLIFIES]
        if calm:
            work = f"{len(at_tol)} random scenes, {tol}, those that amplify less than {AMPLIFIES:g} times ({len(calm)})"
            measured = f"worst error {max(calm):.3g} tolerances, {failed} failed"
            yield Verdict(work, measured, f"{WITHIN:g} tolerances", max(calm) <= WITHIN and failed == 0)


def _of_sampled_load(rows: Sequence[Row]) -> Iterator[Verdict]:
    for row in rows:
        if row.section == "sampled_load" and row.value is not None and row.status == "ok":
            if "256" in row.scene:
                target_text, reached = f"{CORE_SHARE:g} of a core", row.value <= CORE_SHARE
                yield Verdict(f"{row.scene}, {row.setting}", f"{row.value:.2f} of a core", target_text, reached)
            else:
                target_text, reached = f"{REAL_TIME:g} times real time", row.value >= REAL_TIME
                yield Verdict(f"{row.scene}, {row.setting}", f"{row.value:.0f} times real time", target_text, reached)


def _of_idle_time(rows: Sequence[Row]) -> Iterator[Verdict]:
    hours = [row for row in rows if row.section == "machine_time" and row.simulated_s == HOUR_S and row.wall_ms]
    driven = next((row.wall_ms for row in hours if row.scene == "kv"), None)
    for row in hours:
        if driven and row.wall_ms and row.scene != "kv":
            share = row.wall_ms / driven
            measured = f"{row.wall_ms:.3g} ms, {row.steps} steps, {row.events} events: {share:.2%} of the driven hour"
            yield Verdict(f"an hour: {row.scene}", measured, f"near nothing: {IDLE_SHARE:.0%}", share <= IDLE_SHARE)
