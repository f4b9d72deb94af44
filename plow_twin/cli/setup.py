"""The command `plow-twin setup`, which writes a mapping and a stub of a scene for a CSV or Parquet file."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from plow_twin.cli.console import DONE, output_console, say_error, table
from plow_twin.cli.options import FILE, FOLDER, named_option, quiet_option, unit_option
from plow_twin.errors import UnitError

if TYPE_CHECKING:
    from plow_twin.model.scene import Scene
    from plow_twin.record.column_guess import Guess


@click.command(
    short_help="Guess the columns of a CSV or Parquet file, and write a mapping and a stub of a scene.",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage, or a column that cannot be assigned.",
)
@click.argument("file", type=FILE)
@click.option("--scene", help="Scene file or preset of the machine; by default a stub of a scene is written.")
@named_option("--column", "columns", "NAME=COLUMN", "Column of a quantity, e.g. fx=Load_1.")
@unit_option
@click.option("--out", type=FOLDER, default=Path(), help="Folder for the files.")
@quiet_option
def setup(file: Path, scene: str | None, columns: dict[str, str], units: dict[str, str], out: Path, quiet: bool) -> int:
    """Guess the separator, time, columns and units of FILE, and write a mapping and a stub of a scene.

    In a terminal, the command asks for columns that it cannot guess.
    """
    from plow_twin.record.column_guess import guess_columns
    from plow_twin.record.sources import Columns
    from plow_twin.scene_file import load_scene

    nominal = load_scene(scene or "paper")
    guess = guess_columns(file, nominal, columns, units)
    while guess.open:
        name, choices = next(iter(guess.open.items()))
        if quiet or not sys.stdin.isatty():
            raise click.UsageError(
                f"{file}: {', '.join(guess.open)} cannot be determined from the {Columns(guess.names)}; "
                + "state " + " ".join(f"--column {one}=COLUMN" for one in guess.open)
            )  # fmt: skip
        columns[name] = click.prompt(f"Column of {name}", type=click.Choice(choices or guess.names))
        guess = guess_columns(file, nominal, columns, units)
    if scene is not None:
        _check_sizes(guess, nominal, units)
    written = _write(guess, scene, out)
    if not quiet:
        _show(guess)
        for path in written:
            click.echo(path)
        where = scene or str(out / "scene.yaml")
        click.echo(f"next: plow-twin live {file} --map {out / 'map.yaml'} --scene {where} --record runs/first")
    return DONE


def _check_sizes(guess: Guess, scene: Scene, stated: dict[str, str]) -> None:
    from plow_twin.record.unit_check import large_loads

    large = large_loads(guess.values, guess.units, scene)
    wrong = [text for name, text in large.items() if name not in stated]
    if wrong:
        raise UnitError(f"{guess.path}: {'; '.join(wrong)}")
    for text in large.values():
        say_error(f"plow-twin: {guess.path}: {text}")


def _write(guess: Guess, scene: str | None, out: Path) -> list[Path]:
    from plow_twin.scene_file import dump_scene, load_scene

    out.mkdir(parents=True, exist_ok=True)
    files = {"map.yaml": guess.mapping_text()}
    if scene is None:
        files["scene.yaml"] = _STUB + dump_scene(load_scene("paper"))
    for name in files:
        if (out / name).exists():
            raise click.UsageError(f"{out / name}: exists already, expected another folder: --out")
    for name, text in files.items():
        (out / name).write_text(text, encoding="utf-8")
    try:
        from plow_twin.view.own_file import draw_own_file

        picture = [draw_own_file(guess, out / "setup.png")]
    except ModuleNotFoundError:
        say_error("plow-twin: no picture: pip install 'plow_twin[study]'")
        picture = []
    return [*(out / name for name in files), *picture]


_STUB = """\
# A stub: all numbers are from the preset `paper`, a reconstruction, and not from your machine. Replace mass, frame,
# clearance, contact and loads (tutorial, step 1); `plow-twin info scene.yaml` shows all numbers and derived values.
"""


def _show(guess: Guess) -> None:
    import numpy as np

    from plow_twin.record.map_file import QUANTITIES, UNITS
    from plow_twin.scene_file.parquet_lines import is_parquet

    names = {",": "comma", ";": "semicolon", "\t": "tab"}
    comma = ", decimal commas" if guess.decimal_comma else ""
    form = "Parquet" if is_parquet(guess.path) else f"separated by {names[guess.delimiter]}{comma}"
    spacing = float(np.nanmedian(np.diff(guess.stamps_s))) if len(guess.stamps_s) > 1 else float("nan")
    rate = f", a row each {spacing:.4g} s"
    click.echo(f"{guess.path}: {form}{rate}")
    shown = table("Columns", "number", "column", "unit", "largest", "found")
    unit = guess.time_unit or "date"
    shown.add_row("t", guess.time, unit, "", guess.because["t"])
    for (role, name), column in guess.columns.items():
        largest = float(np.nanmax(np.abs(guess.values[role, name]), initial=0.0))
        si = next(iter(UNITS[QUANTITIES[role, name]]))
        shown.add_row(name, column, guess.unit(role, name), f"{largest:.4g} {si}", guess.because[name])
    output_console().print(shown)
