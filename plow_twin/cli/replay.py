"""The command `plow-twin replay`, which replays a recording and compares the results with the recorded outputs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from plow_twin.cli.console import print_facts, progress, say_end, say_error
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
    print_facts(facts, as_json=as_json, quiet=quiet)
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
    facts = {
        "file": str(report.path),
        "result": "diverged" if diverged else "the same, but with losses" if report.loss else "the same",
        "file_status": report.status.value,
        **vars(report),
        "messages_compared": report.compared,
        "messages_not_compared": report.not_compared,
        "first_divergence": None if diverged is None else vars(diverged),
    }
    for name in ("path", "status", "compared", "not_compared"):
        del facts[name]
    return facts
