"""The command `plow-twin estimate`, which estimates clearances and contact parameters from a measured motion."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from plow_twin.cli.console import DONE, DONE_WITH_LOSS, FAILED, busy, counts, output_console, say_error, table
from plow_twin.cli.options import (
    EXISTING,
    FOLDER,
    NEW_FILE,
    PLACE,
    POSITIVE,
    check_rows,
    json_option,
    map_option,
    quiet_option,
)
from plow_twin.errors import UnitError

if TYPE_CHECKING:
    from plow_twin.estimate.forces import Forces
    from plow_twin.estimate.gaps import Gaps
    from plow_twin.estimate.measurements import Load, Poses
    from plow_twin.estimate.result import Estimate
    from plow_twin.model.scene import Scene
    from plow_twin.record.measured import Measured


@click.command(
    short_help="Estimate clearances and contact from measured motion.",
    epilog="Exit codes: 0 done, even if an estimate is withdrawn; 1 failed; 2 wrong usage, scene or units; 3 done with "
    "counted loss, or too few data.",
)
@click.argument("source", metavar="INPUT", type=EXISTING)
@click.option("--scene", type=PLACE, help="Nominal scene, a file or a preset; by default the scene of INPUT.")
@map_option
@json_option
@click.option("--out", type=FOLDER, help="Folder for estimate.json, forces.csv, followed.csv.")
@click.option(
    "--forces",
    "members",
    metavar="N",
    type=click.IntRange(20, 4096),
    help="Compute the forces of each pair with 90 % intervals, from N twins drawn from the estimate (256 are enough).",
)
@click.option(
    "--follow",
    "following",
    is_flag=True,
    help="Write followed.csv: forces and clearances from the measurements up to each time.",
)
@click.option(
    "--follow-dt",
    metavar="S",
    type=POSITIVE,
    help="Time between the rows of followed.csv [s]; by default one row for each sample of the load.",
)
@click.option(
    "--follow-members",
    metavar="N",
    type=click.IntRange(20, 4096),
    default=128,
    show_default=True,
    help="Number of twins for --follow.",
)
@click.option(
    "--plot",
    type=NEW_FILE,
    help="Picture of the fit, with measured and fitted motion, residuals and intervals, as PNG or as .rrd for rerun.",
)
@quiet_option
def estimate(
    source: Path,
    scene: Path | None,
    mapping: Path | None,
    as_json: bool,
    out: Path | None,
    members: int | None,
    following: bool,
    follow_dt: float | None,
    follow_members: int,
    plot: Path | None,
    quiet: bool,
) -> int:
    """Estimate clearances, contact parameters, load gains, bias and delay from INPUT, with 90 % intervals.

    INPUT is a folder with the nominal scene, scene.yaml, and tables in CSV or Parquet. The table load.csv (t, fx, fy,
    m) contains the measured load, and may be missing. The table pose.csv (t, x, y, theta) contains the measured pose;
    its cells may be empty. The optional table gaps.csv (t and columns named after pairs) contains measured gaps, and
    may replace pose.csv. The optional table contact_forces.csv (columns as in gaps.csv) contains measured forces.

    INPUT may also be a run of plow_twin or another recording (MCAP, sqlite3 of rosbag2, CSV, Parquet). If the node of a
    run made estimates, the last estimate is computed again from the journal, and the result is compared bit for bit.
    Otherwise the measured pose must be recorded in the folder of the run.

    With --follow, each row of followed.csv contains forces and clearances with 90 % intervals. The values are computed
    from the measurements up to the time of the row.
    """
    import numpy as np

    from plow_twin.estimate.estimate import warm_up
    from plow_twin.record.durable import whole_file, write_whole
    from plow_twin.record.measured import is_measured
    from plow_twin.record.reader import own_run

    if following and out is None:
        raise click.UsageError("--follow: got no --out, expected the folder for followed.csv")
    folder = mapping is None and is_measured(source)
    live = scene is None and mapping is None and not folder and own_run(source) is not None
    task = (_repeated(source) if live else None) or _given(source, scene, mapping, folder)
    begin = time.perf_counter()
    with busy("compiling", quiet or as_json):
        warm_up(task.scene)
    compile_s, begin = time.perf_counter() - begin, time.perf_counter()
    with busy("estimating", quiet or as_json):
        result, more = task.run()
    unusable = result.lost - sum(more["losses"].values())
    if unusable > 0:
        more["losses"]["unusable_rows"] = unusable
    facts = {**result.as_dict(), **more, "wall_s": time.perf_counter() - begin, "compile_s": compile_s}
    forces = None
    if members is not None:
        with busy("forces", quiet or as_json):
            forces = _forces(task, result, members)
        facts["forces"] = None if forces is None else forces.as_dict()
    text = json.dumps(facts, indent=2, allow_nan=False)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        if forces is not None:
            names, rows = forces.table()
            with whole_file(out / "forces.csv") as stream:
                np.savetxt(stream, rows, fmt="%.9g", delimiter=",", header=",".join(names), comments="")
        if following:
            with busy("following", quiet or as_json):
                names, rows = _followed(_measured(source, scene, mapping, folder), follow_members, follow_dt)
            with whole_file(out / "followed.csv") as stream:
                form = ["%.15g", *["%.9g"] * (len(names) - 1)]
                np.savetxt(stream, rows, fmt=form, delimiter=",", header=",".join(names), comments="")
        write_whole(out / "estimate.json", (text + "\n").encode())
    if plot is not None:
        _plot(task, result, plot, _title(source, scene, task))
    if as_json:
        click.echo(text)
    elif not quiet:
        show_estimate(result, task.scene)
        if "live" in more:
            _show_live(more["live"])
        if forces is not None:
            _show_forces(forces)
    if more.get("live", {}).get("repeated") is False:
        say_error("the estimate from the journal differs from the estimate that the node published")
        return FAILED
    if more["losses"]:
        say_error(f"plow-twin: {source}: lost {counts(more['losses'])}")
    if result.unchecked:
        say_error(f"plow-twin: {source}: {'; '.join(result.reasons)}")
    return DONE_WITH_LOSS if result.lost or more["losses"] or result.unchecked else DONE


@dataclass(frozen=True)
class _Task:
    """An estimate to compute. `first_ns` is the stamp at time 0, or None if it is unknown."""

    scene: Scene
    load: Load
    poses: Poses
    run: Callable[[], tuple[Estimate, dict[str, Any]]]
    first_ns: int | None = None


@dataclass(frozen=True)
class _Recorded:
    measured: Measured
    load: Load
    poses: Poses
    gaps: Gaps | None
    lost: int


def _measured(source: Path, scene: Path | None, mapping: Path | None, folder: bool) -> _Recorded:
    from plow_twin.estimate.gaps import Gaps
    from plow_twin.estimate.measurements import Poses
    from plow_twin.record.measured import read_measured, read_recording

    measured = read_measured(source, scene) if folder else read_recording(source, scene, mapping)
    _check_units(source, measured, mapping, folder)
    load, lost_load = _load_of(measured)
    poses, lost_poses = Poses.of(measured.poses[:, 0], measured.poses[:, 1:], measured.pose_deviation)
    gaps, lost_gaps = Gaps.of(measured.gaps[:, 0], measured.gaps[:, 1:], measured.gaps_deviation)
    lost = measured.unreadable + lost_load + lost_poses + lost_gaps
    return _Recorded(measured, load, poses, gaps if len(gaps.t) else None, lost)


def _load_of(measured: Measured) -> tuple[Load, int]:
    """Return the load and the number of unusable rows. A load that was not measured is zero."""
    from plow_twin.estimate.measurements import Load

    if len(measured.load):
        return Load.of(measured.load[:, 0], measured.load[:, 1:], measured.load_deviation)
    t = (measured.poses if len(measured.poses) else measured.gaps)[:, 0]
    return Load.unmeasured(float(t.max()), float(t.min())), 0


def _given(source: Path, scene: Path | None, mapping: Path | None, folder: bool) -> _Task:
    from plow_twin.estimate.estimate import estimate as run

    recording = _measured(source, scene, mapping, folder)
    measured, lost, forces = recording.measured, recording.lost, None
    if len(measured.forces):
        from plow_twin.estimate.contact_forces import ContactForces

        forces, lost_forces = ContactForces.of(measured.forces[:, 0], measured.forces[:, 1:])
        lost += lost_forces
    losses = {"losses": dict(measured.lost)}

    def found() -> tuple[Estimate, dict[str, Any]]:
        return run(measured.scene, recording.load, recording.poses, lost, recording.gaps, forces), losses

    return _Task(measured.scene, recording.load, recording.poses, found)


def _followed(data: _Recorded, members: int, dt: float | None) -> tuple[list[str], Any]:
    from plow_twin.estimate import followed as offline
    from plow_twin.live.parameters import SPECS

    if not len(data.measured.load):
        raise click.UsageError("--follow: got no load, expected its samples")
    apart = float(max(data.load.t[1:] - data.load.t[:-1], default=0.0))
    longest = SPECS["jump_forward"].metadata["high"]
    if apart > longest:
        raise click.UsageError(f"--follow: got {apart:g} s between two samples, expected at most {longest:g} s")
    check_rows(float(data.load.t[-1] - data.load.t[0]), dt, "--follow-dt")
    stretch = offline.follow(data.measured.scene, data.load, data.poses, members, dt, gaps=data.gaps)
    return offline.table(stretch.rows)


#: Advice to a user whose numbers are not in SI units.
_REMEDY: Final = "convert the file, or state the unit in a mapping (--map)"


def _check_units(source: Path, measured: Measured, mapping: Path | None, folder: bool) -> None:
    """Raise a `UnitError` for numbers that seem to be in another unit than the mapping states, by default in SI units.

    Loads in a run of plow_twin only cause a warning, because their units cannot be stated afterwards.
    """
    from plow_twin.record.mapping import read_map
    from plow_twin.record.reader import own_run
    from plow_twin.record.sources import open_source
    from plow_twin.record.unit_check import unit_doubts, unstated

    values = {("excitation", name): measured.load[:, 1 + place] for place, name in enumerate(("fx", "fy", "m"))}
    values |= {("head_pose", name): measured.poses[:, 1 + place] for place, name in enumerate(("x", "y", "theta"))}
    doubts = unit_doubts(values, measured.load[:, 0], measured.scene)
    if doubts and not folder and own_run(source) is not None:
        for doubt in doubts:
            if not doubt.is_impossible:
                say_error(f"plow-twin: {source}: {doubt}")
        refused = [doubt for doubt in doubts if doubt.is_impossible]
    else:
        roles = read_map(mapping, open_source(source).topics()) if doubts and not folder else {}
        possible = [doubt for doubt in doubts if not doubt.is_impossible]
        refused = [doubt for doubt in doubts if doubt.is_impossible] + unstated(possible, roles)
    if refused:
        raise UnitError(f"{source}: " + "; ".join(f"{doubt}: {doubt.advice or _REMEDY}" for doubt in refused))


def _repeated(source: Path) -> _Task | None:
    """Return the task to repeat the last estimate of a live node, or None if there is no estimate."""
    from plow_twin.estimate.answer import answer
    from plow_twin.live.estimation import requests_of
    from plow_twin.live.parameters import settings
    from plow_twin.record.estimated import live_estimates
    from plow_twin.record.reader import RunReader

    reader = RunReader(source)
    estimates = list(live_estimates(reader))
    whole = [(estimate.entry, estimate.window) for estimate in estimates if estimate.window is not None]
    if not whole:
        return None
    entry, window = whole[-1]
    scene = reader.header.scene(reader.path)
    losses = {**reader.lost, "damaged_chunks": reader.damaged_chunks, **reader.lost_parts}
    losses = {name: count for name, count in losses.items() if count}

    def run() -> tuple[Estimate, dict[str, Any]]:
        again = answer(scene, window, entry.guess, requests_of(settings(reader.header.parameters)))
        same = again.text == entry.result
        live = {"estimates": len(estimates), "repeated": same, "start_ns": entry.start_ns, "end_ns": entry.end_ns}
        return again.estimate, {**again.also, "live": live, "losses": losses}

    return _Task(scene, window.load, window.pose, run, entry.start_ns)


def _title(source: Path, scene: Path | None, task: _Task) -> str:
    from datetime import UTC, datetime

    from plow_twin.view.figures import date_text

    date = date_text(task.first_ns) or f"drawn {datetime.now(UTC):%Y-%m-%d}"
    scene_text = "its own scene" if scene is None else f"scene {scene.name}"
    return f"Estimate from {source.resolve().name}, {scene_text}, {date}"


def _plot(task: _Task, result: Estimate, path: Path, title: str) -> None:
    from plow_twin.estimate.summary import priors
    from plow_twin.view.estimate import estimate_picture
    from plow_twin.view.fitted import write_fit_picture

    prior = priors(task.scene, task.load, task.poses)
    write_fit_picture(estimate_picture(result, prior, task.poses, _labels(task.scene), title), path)


def _labels(scene: Scene) -> dict[str, str]:
    from plow_twin.cli.scene_facts import damping_unit
    from plow_twin.estimate.unknowns import QUANTITIES

    labels = {quantity.name: quantity.label for quantity in QUANTITIES}
    labels["damping"] = "restitution [1]" if scene.contact.damping is None else f"damping [{damping_unit(scene)}]"
    power = scene.contact.exponent
    labels["stiffness"] = labels["stiffness"].replace("m^n", "m" if power == 1.0 else f"m^{power:g}")
    return labels


def _forces(task: _Task, result: Estimate, members: int) -> Forces | None:
    """Return the contact forces under the measured load, or None if the estimate is not sufficient to compute them."""
    from plow_twin.estimate.forces import forces_of
    from plow_twin.estimate.result import State

    if {State.WITHDRAWN, State.PRIOR} & {result.horizontal_state, result.vertical_state} or result.noise is None:
        return None
    return forces_of(task.scene, result, task.load, members, task.load.period())


def _show_forces(forces: Forces) -> None:
    from plow_twin.model.pairs import PAIR_NAMES

    view = table(f"Largest forces from {forces.t[0]:.2f} s on [kN]", "", "5 %", "50 %", "95 %")
    for name, peaks in zip(PAIR_NAMES, forces.peak.T, strict=True):
        view.add_row(name, *(f"{1e-3 * peak:.1f}" for peak in peaks))
    output_console().print(view)


def _show_live(live: dict[str, Any]) -> None:
    same = "equal bit for bit" if live["repeated"] else "not the same"
    window = f"{1e-9 * live['start_ns']:.3f} s to {1e-9 * live['end_ns']:.3f} s"
    text = (
        f"the last of {live['estimates']} estimates of the node, computed again: {same}; its window by stamp: {window}"
    )
    output_console().print(text, highlight=False, soft_wrap=True)


def show_estimate(result: Estimate, scene: Scene) -> None:
    """Print an estimate as a table."""
    from plow_twin.view.estimate import estimated_rows

    view = table(
        f"Estimate of the window from {result.t_start:.2f} s to {result.t_end:.2f} s", "", "mean", "5 %", "95 %", ""
    )
    for label, value, factor, form, state in estimated_rows(result, _labels(scene)).values():
        numbers = (format(factor * number, form) for number in (value.mean, value.p05, value.p95))
        view.add_row(label, *numbers, state)
    console = output_console()
    console.print(view)
    console.print(result.trust, highlight=False)
    if result.forces_measured is not None:
        measured = result.forces_measured.as_dict()
        why = measured["unused"] and f": {measured['unused']}"
        console.print(f"measured forces: {measured['rows']} rows used{why}", highlight=False)
    for reason in result.reasons:
        console.print(f"  {reason}", highlight=False)
