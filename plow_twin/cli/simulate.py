"""The command `plow-twin simulate`, which simulates a scene offline."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import click

from plow_twin.cli.console import DONE, output_console, progress, table
from plow_twin.cli.options import NEW_FILE, POSITIVE, check_rows, json_option, quiet_option

if TYPE_CHECKING:
    from rich.table import Table

    from plow_twin.errors import LimitError, RunInterrupted
    from plow_twin.run.energy_balance import EnergyBalance
    from plow_twin.run.simulate import Result


@click.command(short_help="Simulate a scene.", epilog="Exit codes: 0 done, 1 failed, 2 wrong usage or scene.")
@click.argument("scene")
@click.option("--t-end", metavar="T", type=POSITIVE, required=True, help="Time to simulate [s].")
@click.option("--output-dt", type=POSITIVE, help="Time between output rows [s]; by default a thousandth of --t-end.")
@click.option("--tol", type=POSITIVE, default=1e-9, show_default=True, help="Tolerance, relative to the clearance.")
@click.option("--out", type=NEW_FILE, help="File for the output rows, .csv or .npz.")
@json_option
@click.option(
    "--method",
    type=click.Choice(["events", "rk4", "euler"]),
    default="events",
    show_default=True,
    help="Solver with event detection (events), or with fixed steps for comparison (rk4, euler).",
)
@click.option("--dt", type=POSITIVE, help="Step of rk4 and euler [s].")
@click.option(
    "--energy-balance",
    is_flag=True,
    help="Compute the balance of energy and momentum, which takes about four times as long.",
)
@click.option(
    "--trust",
    is_flag=True,
    help="Report the growth of errors and the time for which the tolerance is met, which takes ten times as long.",
)
@click.option(
    "--max-steps", type=click.IntRange(min=1), default=10**8, show_default=True, help="Largest number of steps."
)
@click.option(
    "--max-wall", metavar="S", type=POSITIVE, default=3600.0, show_default=True, help="Longest wall-clock time [s]."
)
@quiet_option
def simulate(
    scene: str,
    t_end: float,
    output_dt: float | None,
    tol: float,
    out: Path | None,
    as_json: bool,
    method: str,
    dt: float | None,
    energy_balance: bool,
    trust: bool,
    max_steps: int,
    max_wall: float,
    quiet: bool,
) -> int:
    """Simulate SCENE, a file or one of the presets paper, bench_kv, bench_hc, measured_square, measured_ellipse.

    After Ctrl-C or at a limit, files and JSON contain the results up to this time, and the exit code is 1.
    """
    _check_usage(out, method, dt)
    check_rows(t_end, output_dt, "--output-dt")
    result, stopped = _run(
        scene,
        quiet,
        t_end,
        output_dt,
        tol,
        method,
        dt,
        energy_balance,
        max_steps=max_steps,
        max_wall_s=max_wall,
        sensitivity=trust,
    )
    t_end = t_end if stopped is None else stopped.time_s
    if out is not None:
        write_samples(result, out)
    if as_json:
        facts = _facts(result, scene, t_end)
        click.echo(json.dumps(facts, indent=2, allow_nan=False, default=lambda array: array.tolist()))
    elif not quiet:
        _print_statistics(result, scene, t_end)
        if result.sensitivity is not None:
            output_console().print(str(result.sensitivity))
    if stopped is not None:
        raise stopped
    return DONE


def _run(
    scene: str, quiet: bool, t_end: float, *settings: Any, **limits: Any
) -> tuple[Result, LimitError | RunInterrupted | None]:
    """Return the result of a simulation, and the reason if it ended early: a limit or Ctrl-C."""
    from plow_twin.errors import LimitError, RunInterrupted, SceneError, ToleranceWarning
    from plow_twin.run.simulate import simulate as run
    from plow_twin.scene_file import load_scene

    model = load_scene(scene)
    try:
        title = f"simulating {t_end:g} s (the first run compiles)"
        with progress(title, quiet) as on_progress, warnings.catch_warnings():
            warnings.simplefilter("ignore", ToleranceWarning)
            return run(model, t_end, *settings, **limits, on_progress=on_progress), None
    except (LimitError, RunInterrupted) as stop:
        return stop.result, stop
    except SceneError:
        raise
    except ValueError as error:
        raise click.UsageError(str(error)) from None


def _check_usage(out: Path | None, method: str, dt: float | None) -> None:
    if out is not None and out.suffix not in (".csv", ".npz"):
        raise click.BadParameter(f"got {out.name!r}, expected a name that ends in .csv or .npz", param_hint="--out")
    if out is not None and not out.parent.is_dir():
        raise click.BadParameter(f"got {str(out)!r}, expected an existing folder before the name", param_hint="--out")
    if method == "events" and dt is not None:
        raise click.BadParameter("got a step with method events, expected rk4 or euler", param_hint="--dt")
    if method != "events" and dt is None:
        raise click.BadParameter(f"got nothing, expected the step of {method} [s]", param_hint="--dt")


def write_samples(result: Result, path: Path) -> None:
    """Write the output rows as .csv or as .npz.

    Numbers in a .csv file have 17 digits. A .npz file contains all contact events in addition.
    """
    from plow_twin.record.durable import whole_file

    with whole_file(path) as stream:
        (_write_csv if path.suffix == ".csv" else _write_npz)(result, stream)


def _write_csv(result: Result, stream: BinaryIO) -> None:
    import numpy as np

    from plow_twin.model.pairs import PAIR_NAMES

    names = ["t", "x", "y", "theta", "vx", "vy", "omega", *(f"force_{name}" for name in PAIR_NAMES)]
    rows = np.column_stack([result.t, result.q, result.v, result.force])
    np.savetxt(stream, rows, fmt="%.17g", delimiter=",", header=",".join(names), comments="")


def _write_npz(result: Result, stream: BinaryIO) -> None:
    import numpy as np

    events = result.events
    more: dict[str, Any] = {} if result.frame is None else {"frame": result.frame}
    np.savez(
        stream,
        t=result.t,
        q=result.q,
        v=result.v,
        force=result.force,
        penetration=result.penetration,
        **more,
        event_time=events["time"],
        event_pair=events["pair"],
        event_from=events["mode_from"],
        event_to=events["mode_to"],
        event_rate=events["rate"],
    )


def _facts(result: Result, scene: str, t_end: float) -> dict[str, Any]:
    """Return the result without the output rows as a dictionary for JSON."""
    facts: dict[str, Any] = {
        "scene": scene,
        "t_end": t_end,
        "pairs": result.statistics,
        "contact_sets": result.contact_sets,
        "solver": result.solver,
        "wall_s": result.wall_s,
        "compile_s": result.compile_s,
    }
    if (trust := result.sensitivity) is not None:
        facts["trust"] = {
            "trusted": trust.trusted,
            "growth": trust.growth.max(),
            "lyapunov_exponent_1_s": trust.exponent,
            "good_to_1_percent_until_s": trust.good_until(1e-2),
        }
    if (balance := result.energy_balance) is not None:
        facts["energy_balance"] = {**vars(balance), "relative_imbalance": balance.relative_imbalance}
    return facts


def _balance_table(balance: EnergyBalance) -> Table:
    rows = table("balance of energy", "quantity", "J")
    kinetic, stored = (end - start for start, end in (balance.kinetic_j, balance.stored_j))
    for name, value in (
        ("work of the loads", balance.load_work_j),
        ("work of gravity", balance.gravity_work_j),
        ("- dissipated in contacts", -balance.dissipated_j),
        ("- dissipated by friction", -balance.friction_work_j),
        ("- taken by the support", -balance.support_work_j),
        ("- stored in contacts, end minus start", -stored),
        ("= kinetic energy gained", kinetic),
    ):
        rows.add_row(name, f"{value + 0.0:.6g}")  # the sum of negative zero and 0.0 is positive zero
    rows.add_row("largest imbalance at any step", f"{balance.imbalance_j:.3g}")
    rows.add_row("largest imbalance over turnover", f"{balance.relative_imbalance:.1e}")
    rows.add_row(
        "largest imbalance of momentum [N s, N s, N m s]", " ".join(f"{v:.1e}" for v in balance.momentum_imbalance)
    )
    return rows


def _print_statistics(result: Result, scene: str, t_end: float) -> None:
    console = output_console()
    columns = ("max kN", "mean in contact kN", "mean kN", "impulse kN s", "contact s", "makes")
    forces = table(f"{scene}, {t_end:g} s", "pair", *columns)
    for name, row in result.statistics.items():
        kilo = (f"{row[key] / 1e3:.2f}" for key in ("max", "mean_in_contact", "mean_over_time", "impulse"))
        forces.add_row(name, *kilo, f"{row['time_in_contact']:.3f}", f"{row['makes']}")
    console.print(forces)
    sets = table("contact sets, share of contact time", "corners in contact", "counter-clockwise", "clockwise")
    ccw, cw = result.contact_sets["ccw"], result.contact_sets["cw"]
    for name in sorted({*ccw, *cw}, key=lambda name: (len(name), name)):
        sets.add_row(name, f"{ccw.get(name, 0.0):.1%}", f"{cw.get(name, 0.0):.1%}")
    console.print(sets)
    if result.energy_balance is not None:
        console.print(_balance_table(result.energy_balance))
    solver = ", ".join(f"{key} {value}" for key, value in result.solver.items())
    console.print(f"{solver}; {result.wall_s * 1e3:.1f} ms, compiled in {result.compile_s:.1f} s", highlight=False)
