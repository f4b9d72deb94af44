"""The command `plow-twin study calibrate`, which fits unknown parameters of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from plow_twin.cli.console import DONE, DONE_WITH_LOSS, output_console, progress, say_error, say_lost, table
from plow_twin.cli.options import EXISTING, FOLDER, NEW_FILE, POSITIVE, quiet_option
from plow_twin.cli.study_options import set_option, study_scene, usage_errors
from plow_twin.scene_file.presets import config_folder

if TYPE_CHECKING:
    from plow_twin.model.scene import Scene
    from plow_twin.study.calibration.calibrate import Calibration, Search
    from plow_twin.study.calibration.fit import Fit
    from plow_twin.study.calibration.objective import Objective
    from plow_twin.study.calibration.unknowns import Space


@click.command(
    short_help="Fit unknown parameters to published figures or to a recorded motion.",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage, scene or targets, 3 done, but the recording has losses.",
)
@click.argument("scene")
@click.option(
    "--unknown",
    "unknowns",
    multiple=True,
    metavar="RANGE",
    help="Unknown parameter: PATH=LOW:HIGH[:log], PATH=CHOICE,CHOICE.. or, for a sign, PATH. May be repeated; by "
    "default the unknowns of the target file.",
)
@click.option(
    "--target", metavar="FILE", help="Target file with the figures to fit, or `paper` for those of the paper."
)
@click.option(
    "--without", multiple=True, metavar="PATTERN", help="Names of targets to omit, e.g. 'max at*'; may be repeated."
)
@click.option(
    "--recording",
    type=EXISTING,
    help="Motion to fit: .csv, .parquet or .npz with t, x, y, theta, or a run of plow_twin, whose measured poses are "
    "used if there are any.",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the random numbers.")
@click.option("--starts", type=click.IntRange(1), default=8, show_default=True, help="Number of random starts.")
@click.option("--screen", type=click.IntRange(1), default=200, show_default=True, help="Random points of a start.")
@click.option("--population", type=click.IntRange(5), default=30, show_default=True, help="Population of a start.")
@click.option("--generations", type=click.IntRange(0), default=40, show_default=True, help="Generations of a start.")
@click.option(
    "--simplex",
    type=click.IntRange(0),
    help="Evaluations of the final simplex search; by default 200 with --target, 0 with --recording.",
)
@click.option("--t-end", metavar="T", type=POSITIVE, help="Time to simulate [s]; by default from the target file.")
@click.option("--tol", type=POSITIVE, help="Tolerance; by default from the target file, or 1e-8 with --recording.")
@click.option(
    "--excess",
    type=POSITIVE,
    help="Largest difference from the best objective at which a point is near-optimal; by default 10 % of the best.",
)
@click.option("--out", type=FOLDER, required=True, help="Folder of the results.")
@click.option(
    "--plot",
    type=NEW_FILE,
    help="Picture of the fit, with measured and fitted values, residuals and ranges, as PNG. With --recording, it may "
    "be .rrd for rerun.",
)
@set_option
@click.option("--workers", type=click.IntRange(1), help="Threads; all cores by default.")
@quiet_option
def calibrate(
    scene: str,
    out: Path,
    plot: Path | None,
    quiet: bool,
    settings: tuple[str, ...],
    unknowns: tuple[str, ...],
    **options: Any,
) -> int:
    """Fit unknown parameters of SCENE to published figures or to a recorded motion.

    The results are written to fit.yaml and calibration.json.
    """
    from plow_twin.study.calibration.calibrate import Search
    from plow_twin.study.calibration.fit import write_fit
    from plow_twin.study.calibration.objective import RecordingObjective
    from plow_twin.study.calibration.unknowns import Space, check_usable, parse_unknown

    if plot is not None:
        _check_plot(plot, options)
    with usage_errors():
        model, objective, source, proposed = _objective(scene, settings, options)
        texts = _merged(proposed, unknowns)
        space = Space(tuple(parse_unknown(text, model) for text in texts))
        check_usable(space, model)
    simplex = options["simplex"]
    if simplex is None:
        simplex = 0 if options["target"] is None else 200
    search = Search(options["screen"], options["population"], options["generations"], simplex)
    fit = _run(model, space, objective, source, search, options, quiet)
    arguments = {"scene": scene, "settings": settings, "unknowns": texts, **options, "simplex": simplex}
    plain = {key: str(value) if isinstance(value, Path) else value for key, value in arguments.items()}
    write_fit(fit, space, plain, out)
    if plot is not None:
        _plot(fit, space, objective, f"Calibration of {scene} to {source}, drawn {datetime.now(UTC):%Y-%m-%d}", plot)
    if not quiet:
        _show(fit, space, out)
    return DONE_WITH_LOSS if isinstance(objective, RecordingObjective) and objective.recording.losses else DONE


def _merged(proposed: Sequence[str], given: Sequence[str]) -> tuple[str, ...]:
    """Return the unknowns of the user, `given`, and those of the target file, `proposed`, that they do not replace.

    Damping and restitution count as one parameter. The text `PATH=fixed` removes an unknown.
    """
    paths = {text.partition("=")[0] for text in given}
    if paths & {"contact.damping", "contact.restitution"}:
        paths |= {"contact.damping", "contact.restitution"}
    kept = [text for text in proposed if text.partition("=")[0] not in paths]
    return (*kept, *(text for text in given if text.partition("=")[2] != "fixed"))


def _check_plot(plot: Path, options: dict[str, Any]) -> None:
    from plow_twin.study.report import require

    if plot.suffix == ".rrd" and options["recording"] is None:
        raise click.UsageError(f"--plot: got {plot.name} with --target, expected a PNG: figures have no motion")
    require("rerun" if plot.suffix == ".rrd" else "matplotlib")


def _plot(fit: Fit, space: Space, objective: Objective, title: str, path: Path) -> None:
    from plow_twin.study.calibration.objective import RecordingObjective
    from plow_twin.study.calibration.picture import draw_motion, draw_targets

    if isinstance(objective, RecordingObjective):
        draw_motion(fit, space, objective, title, path)
    else:
        draw_targets(fit, space, title, path)


def _objective(
    scene: str, settings: Sequence[str], options: dict[str, Any]
) -> tuple[Scene, Objective, str, tuple[str, ...]]:
    """Return the scene, the objective function, the name of the fitted data, and the unknowns in the target file."""
    from dataclasses import replace

    from plow_twin.record.unit_check import check_poses
    from plow_twin.study.calibration.objective import RecordingObjective, TargetObjective
    from plow_twin.study.calibration.pose_recording import load_poses
    from plow_twin.study.calibration.targets import load_targets

    target, recording, workers = options["target"], options["recording"], options["workers"]
    if (target is None) == (recording is None):
        raise click.UsageError("expected either --target or --recording")
    for name, value in (("--without", options["without"]), ("--t-end", options["t_end"])):
        if value and target is None:
            raise click.UsageError(f"{name}: got it with --recording, expected it only with --target")
    model = study_scene(scene, settings)
    if recording is not None:
        poses = load_poses(recording)
        check_poses(poses.t, poses.q, model, recording)
        say_lost(recording, poses.losses)
        if poses.computed:
            say_error(
                f"plow-twin: {recording}: got no measured pose, so the fit is to the motion that the twin computed"
            )
        if poses.load is not None:
            marks = {key: mark for key, mark in model.marks.items() if not key.startswith("loads")}
            model = replace(model, loads=(poses.load,), marks=marks)
        objective = RecordingObjective(model, poses, options["tol"] or 1e-8, workers)
        return model, objective, f"the motion {recording.name}", ()
    path = config_folder() / "paper_targets.yaml" if target == "paper" else Path(target)
    targets = load_targets(path, model).without(options["without"])
    targets = replace(targets, t_end_s=options["t_end"] or targets.t_end_s, tol=options["tol"] or targets.tol)
    source = "the paper's published figures" if target == "paper" else f"the figures of {path.name}"
    return model, TargetObjective(model, targets, workers), source, targets.unknowns


def _run(
    model: Scene,
    space: Space,
    objective: Objective,
    source: str,
    search: Search,
    options: dict[str, Any],
    quiet: bool,
) -> Fit:
    from plow_twin.study.calibration.calibrate import calibrate as fit_to
    from plow_twin.study.calibration.calibrate import objective_of
    from plow_twin.study.calibration.fit import Fit, fitted_scene, target_rows
    from plow_twin.study.calibration.objective import TargetObjective
    from plow_twin.study.calibration.uniqueness import identifiability, near_optimal

    first = space.point(model)
    with progress("calibrating", quiet) as on_progress:
        fitted: Calibration = fit_to(
            space, objective, seed=options["seed"], starts=options["starts"], search=search, first=first,
            on_progress=lambda share, best: on_progress(share),
        )  # fmt: skip
    values = fitted.best.values
    excess = options["excess"] or max(0.1 * fitted.best.objective, 1e-12)
    return Fit(
        fitted_scene(model, values, source), fitted, search, source,
        identifiability(space, objective, fitted.best.point), near_optimal(space, fitted, excess),
        None if first is None else objective_of(objective, {}),
        target_rows(objective, values) if isinstance(objective, TargetObjective) else [],
    )  # fmt: skip


def _show(fit: Fit, space: Space, out: Path) -> None:
    from plow_twin.study.calibration.uniqueness import near_optimal_ends

    console = output_console()
    calibration = fit.calibration
    before = "" if fit.before is None else f" (before the fit: {fit.before:.4g})"
    shown = table(
        f"best of {len(calibration.starts)} starts, objective {calibration.best.objective:.4g}{before}",
        "unknown",
        "fitted",
    )
    shown.add_column("near-optimal", justify="right")
    for unknown in space.unknowns:
        value = calibration.best.values[unknown.path]
        low_high = near_optimal_ends(fit.clusters, unknown.path)
        spread = "" if low_high is None else f"{low_high[0]:.5g} .. {low_high[1]:.5g}"
        shown.add_row(unknown.path, value if isinstance(value, str) else f"{value:.6g}", spread)
    console.print(shown)
    if fit.targets:
        _show_targets(console, fit)
    singular = ", ".join(f"{value:.3g}" for value in fit.identifiability.singular_values)
    console.print(f"singular values of the Jacobian over the ranges: {singular}", highlight=False, soft_wrap=True)
    objectives = ", ".join(f"{start.objective:.4g}" for start in calibration.starts)
    console.print(f"objective of each start: {objectives}", highlight=False, soft_wrap=True)
    sizes = ", ".join(f"{cluster.objective:.4g} ({cluster.members})" for cluster in fit.clusters[:8])
    console.print(
        f"clusters of near-optimal points: {len(fit.clusters)}, objective (points): {sizes}\n"
        f"{calibration.runs} runs; {out / 'fit.yaml'}, {out / 'calibration.json'}",
        highlight=False,
        soft_wrap=True,
    )


def _show_targets(console: Any, fit: Fit) -> None:
    from plow_twin.study.statistics import unit_of

    met = sum(row.met for row in fit.targets)
    shown = table(f"{met} of {len(fit.targets)} targets met", "target")
    shown.columns[0].no_wrap = False
    for name in ("got", "unit", "residual", "met"):
        shown.add_column(name, justify="right", min_width=len(name))
    for row in fit.targets:
        unit = unit_of(row.statistic)
        shown_unit = {"N": "kN", "1": ""}.get(unit, unit)
        got = " ".join(f"{1e-3 * value if unit == 'N' else value:.4g}" for value in row.got)
        shown.add_row(row.name, got, shown_unit, f"{row.residual:.2f}", "yes" if row.met else "no")
    console.print(shown)
