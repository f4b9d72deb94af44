"""Functions that several verbs use for exit codes, progress, tables and messages about losses."""

from __future__ import annotations

import json
import shlex
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, Final

import click
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from plow_twin.errors import printable

DONE: Final = 0
FAILED: Final = 1
WRONG_INPUT: Final = 2
DONE_WITH_LOSS: Final = 3

#: Function that receives the share of the work that is done, from 0 to 1.
OnProgress = Callable[[float], None]


def say_error(text: str) -> None:
    """Print a line on standard error. Errors of a full disk or a closed terminal are ignored."""
    with suppress(OSError):
        click.echo(printable(text), err=True)


class PlainConsole(Console):
    """Console that prints texts literally, without interpretation of markup, emoji codes and control characters."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield the segments to print. Control characters in texts are replaced by printable characters."""
        for part in super().render(renderable, options):
            yield part if part.control else Segment(printable(part.text), part.style)


def output_console() -> Console:
    """Return the console for results."""
    return PlainConsole()


def error_console() -> Console:
    """Return the console for progress, which writes to standard error."""
    return PlainConsole(stderr=True)


class _RateColumn(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text("" if not task.speed else f"{100.0 * task.speed:.2g} %/s")


@contextmanager
def progress(title: str, quiet: bool) -> Iterator[OnProgress]:
    """Show a progress bar on standard error, and yield the function that receives the progress.

    After Ctrl-C, this function raises KeyboardInterrupt.
    """
    with progress_bar(title, quiet) as update, _interruption() as interrupted:

        def on_progress(share: float) -> None:
            if interrupted():
                raise KeyboardInterrupt
            update(share)

        yield on_progress


@contextmanager
def progress_bar(title: str, quiet: bool) -> Iterator[OnProgress]:
    """Show a progress bar on standard error, and yield the function that receives the progress.

    Signal handlers are not changed.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=30),
        TaskProgressColumn(),
        _RateColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    console = error_console()
    with Progress(*columns, console=console, transient=True, disable=quiet or not console.is_terminal) as bar:
        task = bar.add_task(title, total=1.0)
        yield lambda share: bar.update(task, completed=share)


@contextmanager
def _interruption() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether Ctrl-C was pressed.

    The function is needed because a KeyboardInterrupt is lost if it is raised in a destructor.
    """
    before, asked = signal.getsignal(signal.SIGINT), False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        signal.default_int_handler(number, frame)

    if before is not signal.default_int_handler or threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    signal.signal(signal.SIGINT, note)
    try:
        yield lambda: asked
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def busy(title: str, quiet: bool) -> Iterator[None]:
    """Show on standard error that work of unknown duration is in progress."""
    if quiet:
        yield
        return
    with error_console().status(title):
        yield


def table(title: str, *columns: str) -> Table:
    """Return a table with a first column of text and further columns of numbers."""
    result = Table(title=title, title_justify="left")
    for index, name in enumerate(columns):
        result.add_column(name, justify="left" if index == 0 else "right", no_wrap=index == 0)
    return result


def show_facts(console: Console, facts: Mapping[Any, Any]) -> None:
    """Print each fact on a line, with all values in one column. The items of a mapping are indented."""
    lines = list(_lines(facts))
    width = max([24, *(len(name) for name, _ in lines)])
    for name, value in lines:
        text = f"{name:{width}} {value}" if value else name
        console.print(text, highlight=False, markup=False, soft_wrap=True)


def print_facts(facts: Mapping[str, Any], *, as_json: bool, quiet: bool = False) -> None:
    """Print a result as JSON, or as lines of text unless `quiet` is true."""
    if as_json:
        click.echo(json.dumps(facts, indent=2, allow_nan=False))
    elif not quiet:
        show_facts(output_console(), facts)


def _lines(facts: Mapping[Any, Any], indent: int = 0) -> Iterator[tuple[str, str]]:
    """Yield the indented name and the text of each fact; the text of a mapping with items is empty."""
    for key, value in facts.items():
        nested = isinstance(value, Mapping) and len(value) > 0
        yield " " * indent + str(key), "" if nested else _plain(value)
        if nested:
            yield from _lines(value, indent + 2)


def _plain(value: Any) -> str:
    if value is None or (isinstance(value, Mapping | Sequence) and len(value) == 0):
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def counts(numbers: Mapping[str, int]) -> str:
    """Return a line of text with names and counts."""
    return ", ".join(f"{name}: {count}" for name, count in numbers.items())


def say_end(recording: object, status: str) -> None:
    """Print the status of an incomplete recording, and the verb that repairs it."""
    from plow_twin.record.reader import FileStatus

    if status not in (FileStatus.COMPLETE.value, FileStatus.UNREAD.value):
        remedy = f"; plow-twin doctor --repair {shlex.quote(str(recording))} completes it after the end of the run"
        remedy = remedy if status == FileStatus.TRUNCATED.value else ""
        say_error(f"plow-twin: {recording}: {status}{remedy}")


def say_lost(recording: object, lost: Mapping[str, int]) -> None:
    """Print the losses of a recording, and its status if it is incomplete."""
    from plow_twin.record.reader import FileStatus

    ends = {status.value for status in FileStatus}
    for status in ends.intersection(lost):
        say_end(recording, status)
    if other_losses := {name: count for name, count in lost.items() if name not in ends}:
        say_error(f"plow-twin: {recording}: lost {counts(other_losses)}")
