"""The command `plow-twin replay`, which replays a recording and compares the results with the recorded outputs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from plow_twin.cli.console import output_console, progress, say_end, say_error, show_facts
from plow_twin.cli.options import EXISTING, FOLDER, json_option, quiet_option

if TYPE_CHECKING:
    from plow_twin.record.replay_report import ReplayReport


@click.command(
    short_help="Compute a recording again, and compare the results bit for bit.",
    epilog="Exit codes: 0 equal bit for bit; 1 diverged or failed; 2 wrong usage; 3 equal, but with losses.",
)
@click.argument("recording", type=EXISTING)
@click.option("--digests-only", is_flag=True, help="Compare only the digests of the state.")
@click.option(
    "--write",
    type=FOLDER,
    help="New folder for a recording with the journal and all outputs after each advance; only digests are compared.",
)
@json_option
@quiet_option
def replay(recording: Path, digests_only: bool, write: Path | None, as_json: bool, quiet: bool) -> int:
    """Run the model again with the journal of RECORDING, and compare the results with the recorded outputs."""
    from plow_twin.record.replay import replay as run

    with progress("replaying", quiet) as on_progress:
        report = run(recording, on_progress, digests_only=digests_only, write=write)
    facts = _facts(report)
    if report.nothing:
        say_error("plow-twin: nothing could be compared")
    if as_json:
        click.echo(json.dumps(facts, indent=2, allow_nan=False))
    elif not quiet:
        show_facts(output_console(), facts)
    say_end(recording, report.status.value)
    if report.build_differences:
        other = ", ".join(
            f"{key} {recorded} (here {present})" for key, (recorded, present) in report.build_differences.items()
        )
        say_error(f"plow-twin: warning: recorded by another build, which may round differently: {other}")
    for file, read in report.repeated_parts.items():
        say_error(f"plow-twin: warning: {file} repeats {read}: it is not read")
    for file, keys in report.foreign_parts.items():
        differ = ", ".join(keys)
        say_error(f"plow-twin: warning: {file} belongs to another run (its {differ} differ) and is not read")
    if report.repeated:
        say_error(f"plow-twin: warning: {report.repeated} entries occur more than once")
    if report.first_divergence is not None:
        say_error(f"plow-twin: diverged: {report.first_divergence}")
    return report.exit_code


def _facts(report: ReplayReport) -> dict[str, Any]:
    diverged = report.first_divergence
    return {
        "file": str(report.path),
        "result": "diverged" if diverged else "the same, but with losses" if report.loss else "the same",
        "file_status": report.status.value,
        "stop_reason": report.stop_reason,
        "entries": report.entries,
        "samples": report.samples,
        "steps": report.steps,
        "refused": report.refused,
        "repeated": report.repeated,
        "digests_compared": report.digests_compared,
        "snapshots_compared": report.snapshots_compared,
        "messages_compared": dict(report.compared),
        "messages_not_compared": dict(report.not_compared),
        "divergences": report.divergences,
        "first_divergence": None if diverged is None else vars(diverged),
        "inputs": report.inputs,
        "lost": report.lost,
        "damaged_chunks": report.damaged_chunks,
        "repeated_parts": report.repeated_parts,
        "foreign_parts": report.foreign_parts,
        "build_differences": {key: list(pair) for key, pair in report.build_differences.items()},
        "span_s": report.span_s,
        "wall_s": report.wall_s,
    }
