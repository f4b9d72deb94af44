"""The command `plow-twin export`, which writes a recording as CSV, Parquet or NPZ."""

from __future__ import annotations

from pathlib import Path

import click

from plow_twin.cli.console import DONE, DONE_WITH_LOSS, busy, output_console, say_lost, table
from plow_twin.cli.options import EXISTING, PLACE, quiet_option


@click.command(
    short_help="Write a recording as CSV, Parquet or NPZ.",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage, 3 done, but the recording is incomplete.",
)
@click.argument("recording", metavar="RUN", type=EXISTING)
@click.option("--to", "kind", type=click.Choice(["csv", "parquet", "npz"]), required=True, help="Format.")
@click.option("--out", type=PLACE, required=True, help="Folder (csv, parquet) or file (npz).")
@quiet_option
def export(recording: Path, kind: str, out: Path, quiet: bool) -> int:
    """Write the data of RUN as tables in SI units.

    The tables contain the load, measured poses, forces, peaks, the motion, clearances and wear rates.
    """
    from plow_twin.record.recording import export as write
    from plow_twin.record.recording import read_recording

    opened = read_recording(recording)
    existing = [path for path in ([out] if kind == "npz" else _tables(out, kind)) if path.is_file()]
    if existing:
        raise click.UsageError(f"{existing[0]}: exists already, expected another path: --out")
    with busy("exporting", quiet):
        rows = write(opened, kind, out)
    if not quiet:
        shown = table(str(out), "table", "rows", "columns")
        for name, count in rows.items():
            shown.add_row(name, str(count), str(len(opened[name].columns)))
        output_console().print(shown)
    lost = opened.losses()
    say_lost(recording, lost)
    return DONE_WITH_LOSS if lost else DONE


def _tables(out: Path, kind: str) -> list[Path]:
    from plow_twin.record.recording import COLUMNS

    return [out / f"{name}.{kind}" for name in COLUMNS]
