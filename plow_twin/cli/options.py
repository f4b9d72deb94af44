"""Options and argument types that several verbs use."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import click

EXISTING: Final = click.Path(path_type=Path, exists=True)
FILE: Final = click.Path(path_type=Path, exists=True, dir_okay=False)
FOLDER: Final = click.Path(path_type=Path, file_okay=False)
NEW_FILE: Final = click.Path(path_type=Path, dir_okay=False)
PLACE: Final = click.Path(path_type=Path)
#: Largest number of output rows. A row takes about 200 B.
MOST_ROWS: Final = 10_000_000

quiet_option = click.option(
    "--quiet", "-q", is_flag=True, help="Show no progress and no tables; write files and errors only."
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON on standard output.")
map_option = click.option(
    "--map", "mapping", type=FILE,
    help="YAML mapping file, which assigns topics, columns or nodes to load, travel, pose, gaps and forces.",
)  # fmt: skip


Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


def combined(*options: Decorator) -> Decorator:
    """Return a decorator that adds several options to a command."""

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        for option in reversed(options):
            command = option(command)
        return command

    return add


def wait_option(text: str) -> Decorator:
    """Return the option `--wait` [s] with the help text `text`."""
    return click.option("--wait", type=click.FloatRange(0.0), default=10.0, show_default=True, help=text)


#: Options that identify a running node.
node_options = combined(
    click.option("--namespace", default="", help="Namespace of the node."),
    click.option("--name", default="plow_twin", show_default=True, help="Name of the node."),
    click.option("--scene", help="Scene of the node; needed if its path on the node's machine cannot be read."),
)


def find_ros_wheels() -> None:
    """Let ROS 2 find its message definitions if it was installed from wheels."""
    os.environ.setdefault("AMENT_PREFIX_PATH", sys.prefix)


def named_option(option: str, name: str, expected: str, text: str) -> Decorator:
    """Return an option that may be repeated, with the help `text`.

    The parameter `name` of the command receives the values by name. `expected` begins with the form of a value.
    """

    def parsed(context: click.Context, parameter: click.Parameter, texts: tuple[str, ...]) -> dict[str, str]:
        for text in texts:
            if "=" not in text:
                raise click.BadParameter(f"got {text!r}, expected {expected}")
        return dict(text.partition("=")[::2] for text in texts)

    metavar = expected.partition(",")[0]
    return click.option(option, name, multiple=True, callback=parsed, metavar=metavar, help=text)


unit_option = named_option(
    "--unit", "units", "NAME=UNIT, such as fx=kN or t=ms",
    "Unit of a measured number, e.g. fx=kN, x=mm, theta=deg, t=ms; may be repeated.",
)  # fmt: skip


class PositiveNumber(click.ParamType):  # type: ignore[type-arg]  # generic from click 8.3 on
    """Type of a finite number above zero."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number in a text."""
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not (math.isfinite(number) and number > 0.0):
            self.fail(f"got {value!r}, expected a finite number > 0", param, ctx)
        return number


POSITIVE: Final = PositiveNumber()


def check_rows(duration: float, step: float | None, option: str) -> None:
    """Refuse the step of an option [s] if a row at each step of the duration [s] would be more than `MOST_ROWS`."""
    rows = 0.0 if step is None else duration / step
    if rows > MOST_ROWS:
        expected = f"at most {MOST_ROWS} rows: {duration / MOST_ROWS:g} s"
        raise click.BadParameter(f"got {step:g} s, {rows:.4g} rows, expected {expected}", param_hint=option)
