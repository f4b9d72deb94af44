"""The command `plow-twin forecast`, which predicts the time until a clearance reaches its limit."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from plow_twin.cli.console import DONE, DONE_WITH_LOSS, busy, counts, output_console, say_error, table
from plow_twin.cli.options import FILE, NEW_FILE, POSITIVE, json_option, quiet_option

if TYPE_CHECKING:
    from plow_twin.estimate.coefficient import History
    from plow_twin.model.scene import Scene


#: Ratio of a length to the clearance below which the length was probably given in m instead of mm.
_METRES: Final = 1e-2
_HISTORY: Final = ("km", "horizontal_mm", "horizontal_sd_mm", "vertical_mm", "vertical_sd_mm")


@click.command(
    short_help="Forecast when a clearance reaches its limit.",
    epilog="Exit codes: 0 done, even if the limit is not reached; 1 failed; 2 wrong usage or scene; 3 done, but "
    "part of the run is missing.",
)
@click.argument("scene")
@click.option(
    "--limit-horizontal", metavar="MM", type=POSITIVE, required=True, help="Limit of the horizontal clearance [mm]."
)
@click.option(
    "--limit-vertical", metavar="MM", type=POSITIVE, required=True, help="Limit of the vertical clearance [mm]."
)
@click.option(
    "--horizon", metavar="H", type=POSITIVE, default=4000.0, show_default=True, help="Longest time of operation [h]."
)
@click.option(
    "--stop",
    metavar="H",
    type=POSITIVE,
    help="Time of a planned stop [h]; the probability that the limit is reached before the stop is printed.",
)
@click.option(
    "--face-length", metavar="M", type=POSITIVE, default=250.0, show_default=True, help="Length of a pass [m]."
)
@click.option(
    "--estimate",
    "estimated",
    type=FILE,
    help="The file estimate.json of `plow-twin estimate --out`, with the present clearances and contact parameters.",
)
@click.option(
    "--history",
    type=FILE,
    help="CSV of clearances over the travel (km, horizontal_mm, horizontal_sd_mm, vertical_mm, vertical_sd_mm). The "
    "wear coefficient and the present clearances are computed from it, and --estimate gives only the contact.",
)
@click.option(
    "--scenario",
    "scenarios",
    metavar="NAME:load=X,coefficient=Y",
    multiple=True,
    help="A further forecast with factors of the load and the wear coefficient; may be repeated.",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the random numbers.")
@click.option("--plot", type=NEW_FILE, help="PNG of clearances and probability.")
@json_option
@quiet_option
def forecast(
    scene: str,
    limit_horizontal: float,
    limit_vertical: float,
    horizon: float,
    stop: float | None,
    face_length: float,
    estimated: Path | None,
    history: Path | None,
    scenarios: tuple[str, ...],
    seed: int,
    plot: Path | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Forecast when a clearance of SCENE, which has a section `wear`, reaches its limit.

    SCENE is a scene file, a preset, or a run of plow_twin. For a run, the forecast uses the scene and the wear at the
    end of the run. It also uses the last estimate of the node after the last setting of the wear.
    """
    from plow_twin.estimate.coefficient import coefficient
    from plow_twin.estimate.forecast import Plan, Scenario, with_clearances
    from plow_twin.estimate.forecast import forecast as run
    from plow_twin.estimate.life import LifeError, wear_in_travel

    if stop is not None and stop > horizon:
        raise click.UsageError(f"--stop: got {stop:g} h, expected at most the horizon, --horizon {horizon:g}")
    model, facts_now, lost = _scene(scene)
    try:
        wear_in_travel(model)
    except LifeError as error:
        raise click.UsageError(f"{scene}: {error}") from error
    if estimated is not None:
        facts_now = _estimate(estimated)
    limits = 1e-3 * limit_horizontal, 1e-3 * limit_vertical
    try:
        others = tuple(Scenario.parse(text) for text in scenarios)
        plan = Plan(*limits, horizon, stop, face_length, seed=seed, scenarios=others)
    except LifeError as error:
        raise click.UsageError(str(error)) from error
    if history is None and facts_now is not None:
        _warn_of_assumed(estimated or Path(scene), facts_now)
    with busy("forecasting", quiet or as_json):
        wear_coefficient = None
        if history is None:
            model, deviation = _now(model, facts_now)
        else:
            if estimated is not None:
                model = replace(model, contact=_now(model, facts_now)[0].contact)
            wear_coefficient = coefficient(model, _history(history, model))
            deviation = float(wear_coefficient.deviation[0]), float(wear_coefficient.deviation[1])
            model = with_clearances(
                model,
                float(wear_coefficient.clearance[0]),
                float(wear_coefficient.clearance[1]),
                wear_coefficient.depth,
            )
        _check_limits(limits, model)
        result = run(model, plan, deviation, wear_coefficient)
    facts = result.as_dict()
    if wear_coefficient is not None:
        facts["coefficient_m2_n"] = asdict(wear_coefficient.interval())
    if plot is not None:
        from plow_twin.view.forecast import draw_forecast

        draw_forecast(result, plot, f"Forecast of {Path(scene).name}, drawn {datetime.now(UTC):%Y-%m-%d}")
    facts["lost"] = lost
    if lost:
        say_error(f"plow-twin: {scene}: lost {counts(lost)}; there may be a newer estimate and more wear")
    if as_json:
        click.echo(json.dumps(facts, indent=2, allow_nan=False))
    elif not quiet:
        _show(facts)
    return DONE_WITH_LOSS if lost else DONE


def _check_limits(limits_m: tuple[float, float], scene: Scene) -> None:
    import numpy as np

    from plow_twin.stream.outputs import clearances

    assert scene.wear is not None
    now_m = clearances(scene, np.array(scene.wear.initial_depth_m, np.float64))[:2].tolist()
    for name, limit, now in zip(("horizontal", "vertical"), limits_m, now_m, strict=True):
        option, present = f"--limit-{name}", f"the present clearance, {1e3 * now:.3f} mm"
        if limit <= _METRES * now:
            raise click.UsageError(f"{option}: got {1e3 * limit:g} mm, expected more than {present}; is it in m?")
        if limit <= now:
            say_error(f"plow-twin: {option}: {present}, has already passed {1e3 * limit:g} mm")


def _scene(name: str) -> tuple[Scene, dict[str, Any] | None, dict[str, int]]:
    """Return a scene, or the scene at the end of a run, with its last estimate and the losses of its journal."""
    from plow_twin.record.estimated import left_by
    from plow_twin.record.reader import FileStatus, RunReader, own_run
    from plow_twin.scene_file import load_scene

    path = Path(name)
    run = path.is_dir() or path.suffix == ".mcap"
    reader = RunReader(path) if run else own_run(path) if path.exists() else None
    if reader is None:
        return load_scene(name), None, {}
    scene, newest = left_by(reader)
    counts = {"journal": reader.lost.get("journal", 0), "damaged_chunks": reader.damaged_chunks, **reader.lost_parts}
    counts["truncated_files"] = int(reader.status is FileStatus.TRUNCATED)
    lost = {topic: count for topic, count in counts.items() if count}
    return scene, None if newest is None else json.loads(newest.result), lost


def _estimate(path: Path) -> Any:
    try:
        facts = json.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise click.UsageError(f"{path}: {error}, expected JSON of an estimate") from error
    if not isinstance(facts, dict):
        raise click.UsageError(f"{path}: got {type(facts).__name__}, expected JSON of an estimate")
    return facts


def _history(path: Path, scene: Scene) -> History:
    """Return the clearances in a CSV file, which are compared with the clearances of the scene."""
    from plow_twin.estimate.coefficient import History, RowError
    from plow_twin.estimate.life import LifeError
    from plow_twin.record.sources import read_columns

    table = read_columns(path, _HISTORY)
    if not len(table):
        raise LifeError(f"{path}: got no row, expected at least 2")
    try:
        history = History(1e3 * (table[:, 0] - table[0, 0]), 1e-3 * table[:, [1, 3]], 1e-3 * table[:, [2, 4]])
    except RowError as error:
        got = ", ".join(f"{name} {value:.10g}" for name, value in zip(_HISTORY, table[error.row], strict=True))
        before = f" after km {table[error.row - 1, 0]:.10g}" if error.row else ""
        raise LifeError(
            f"{path}: data row {error.row + 1}: got {got}{before}, expected finite numbers, clearances and deviations "
            "above 0, and km that do not decrease"
        ) from None
    for column, new in ((1, scene.clearance.horizontal_m), (3, scene.clearance.vertical_m)):
        least = float(table[:, column].min())
        if 1e-3 * least <= _METRES * new:
            expected = f"about the scene's clearance, {1e3 * new:.3f} mm"
            raise click.UsageError(f"{path}: {_HISTORY[column]}: got {least:g}, expected {expected}; is it in m?")
    return history


def _warn_of_assumed(source: Path, facts: dict[str, Any]) -> None:
    """Print a warning for each clearance of an estimate that no measurement has determined."""
    from plow_twin.estimate.result import State

    for name in ("horizontal", "vertical"):
        clearance = facts.get(name)
        state = clearance.get("state") if isinstance(clearance, dict) else None
        if state in (State.PRIOR.value, State.NOT_OBSERVABLE.value):
            say_error(
                f"plow-twin: {source}: {name}: got the state {state}, expected estimated or rough: the forecast begins "
                "with an assumed clearance"
            )


def _now(scene: Scene, facts: dict[str, Any] | None) -> tuple[Scene, tuple[float, float]]:
    from plow_twin.estimate.forecast import with_estimate
    from plow_twin.estimate.life import LifeError

    if facts is None:
        return scene, (0.0, 0.0)
    try:
        return with_estimate(scene, facts)
    except LifeError as error:
        raise click.UsageError(str(error)) from error


def _show(facts: dict[str, Any]) -> None:
    view = table("Time to the limit", "", "hours", "km", "passes", "shifts")
    for title, times in (("", facts), *facts["scenarios"].items()):
        for name in ("p10", "p50", "p90"):
            cells = [times[name][key] for key in ("hours", "km", "passes", "shifts")]
            text = ("not reached" if cell is None else f"{cell:.4g}" for cell in cells)
            view.add_row(f"{title} {name.upper()}".strip(), *text)
    console = output_console()
    console.print(view)
    console.print(f"not reached in {facts['horizon_h']:g} h: {100 * facts['not_reached_in_horizon']:.0f} %")
    if "coefficient_m2_n" in facts:
        wear = facts["coefficient_m2_n"]
        console.print(f"wear coefficient {wear['mean']:.3g} m^2/N ({wear['p05']:.3g} .. {wear['p95']:.3g})")
    if facts["probability_before_stop"] is not None:
        console.print(f"reached before the stop: {100 * facts['probability_before_stop']:.0f} %")
