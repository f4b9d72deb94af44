"""`plow-twin forecast`: time to a clearance limit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from plow_twin.cli.console import DONE, POSITIVE, busy, json_option, output_console, quiet_option, table
from plow_twin.scene_file.presets import scene_path

if TYPE_CHECKING:
    from plow_twin.model.scene import Scene


@click.command(epilog="Exit codes: 0 done, also where the limit is not reached; 1 failed; 2 wrong usage or scene.")
@click.argument("scene")
@click.option("--limit-horizontal", metavar="MM", type=POSITIVE, required=True, help="Limit of the clearance [mm].")
@click.option("--limit-vertical", metavar="MM", type=POSITIVE, required=True, help="Limit of the clearance [mm].")
@click.option("--horizon", metavar="H", type=POSITIVE, default=4000.0, show_default=True, help="Hours of operation.")
@click.option("--stop", metavar="H", type=POSITIVE, help="Planned stop: the probability to reach the limit before [h].")
@click.option(
    "--face-length", metavar="M", type=POSITIVE, default=250.0, show_default=True, help="Length of a pass [m]."
)
@click.option(
    "--estimate",
    "estimated",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="estimate.json of `plow-twin estimate --out`: the clearances now, with their intervals.",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="The same seed gives the same bits.")
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
    seed: int,
    as_json: bool,
    quiet: bool,
) -> int:
    """Forecast when a clearance of SCENE, which has a section `wear`, reaches its limit."""
    from plow_twin.estimate.forecast import Plan
    from plow_twin.estimate.forecast import forecast as run
    from plow_twin.scene_file import load_scene

    model, deviation = _now(load_scene(scene_path(scene)), estimated)
    plan = Plan(1e-3 * limit_horizontal, 1e-3 * limit_vertical, horizon, stop, face_length, seed=seed)
    with busy("forecasting", quiet or as_json):
        facts = run(model, plan, deviation).as_dict()
    if as_json:
        click.echo(json.dumps(facts, indent=2, allow_nan=False))
    elif not quiet:
        _show(facts)
    return DONE


def _now(scene: Scene, estimated: Path | None) -> tuple[Scene, tuple[float, float]]:
    """Return the scene with the clearances estimated, if there is an estimate, and their standard deviations."""
    from plow_twin.estimate.forecast import with_clearances
    from plow_twin.estimate.result import NORMAL_P95

    if estimated is None:
        return scene, (0.0, 0.0)
    facts = json.loads(estimated.read_text(encoding="utf-8"))
    values = [facts[name] for name in ("horizontal", "vertical")]
    withdrawn = [name for name in ("horizontal", "vertical") if facts[name]["state"] == "withdrawn"]
    if withdrawn:
        raise click.UsageError(f"--estimate: got a withdrawn {withdrawn[0]} clearance, expected one that holds")
    low, high = ((value["p95_m"] - value["p05_m"]) / (2.0 * NORMAL_P95) for value in values)
    return with_clearances(scene, values[0]["mean_m"], values[1]["mean_m"]), (low, high)


def _show(facts: dict[str, Any]) -> None:
    view = table("Time to the limit", "", "hours", "km", "passes", "shifts")
    for name in ("p10", "p50", "p90"):
        cells = [facts[name][key] for key in ("hours", "km", "passes", "shifts")]
        view.add_row(name.upper(), *("not reached" if cell is None else f"{cell:.4g}" for cell in cells))
    console = output_console()
    console.print(view)
    console.print(f"not reached in {facts['horizon_h']:g} h: {100 * facts['not_reached_in_horizon']:.0f} %")
    if facts["probability_before_stop"] is not None:
        console.print(f"reached before the stop: {100 * facts['probability_before_stop']:.0f} %")
