"""The command `plow-twin info`, which describes a scene, a recording or the installation."""

from __future__ import annotations

import csv
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from plow_twin.cli.console import DONE, DONE_WITH_LOSS, output_console, say_end, show_facts, table
from plow_twin.cli.options import json_option, map_option, unit_option
from plow_twin.errors import RecordingError
from plow_twin.scene_file.presets import PRESETS


@click.command(
    short_help="Describe a scene, a recording or this installation.",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage or scene, 3 the recording has losses.",
)
@click.argument("target", required=False)
@click.option("--unused", is_flag=True, help="Print each unused message of a recording, one per line.")
@map_option
@unit_option
@json_option
def info(target: str | None, unused: bool, mapping: Path | None, units: dict[str, str], as_json: bool) -> int:
    """Describe TARGET, which is a scene (file or preset) or a recording. Without TARGET, describe this installation."""
    if target is not None and (mapping is not None or units):
        from plow_twin.record.foreign_facts import foreign_facts

        facts, lossy = foreign_facts(Path(target), mapping, units)
        _show(facts, as_json)
        return DONE_WITH_LOSS if lossy else DONE
    if unused and target is not None:
        return _unused(Path(target), as_json)
    if target is None:
        return _show(_environment(), as_json)
    if Path(target).suffix == ".mcap" or Path(target).is_dir():
        return _recording(Path(target), as_json)
    if Path(target).suffix.lower() in (".csv", ".parquet"):
        raise RecordingError(f"{target}: got a table, expected --map with a mapping of its load, travel and pose")
    return _scene(target, as_json)


def _show(facts: dict[str, Any], as_json: bool) -> int:
    if as_json:
        click.echo(json.dumps(facts, indent=2))
        return DONE
    show_facts(output_console(), facts)
    return DONE


def _environment() -> dict[str, Any]:
    from importlib.metadata import PackageNotFoundError, version

    from plow_twin.build import build_fingerprint
    from plow_twin.scene_file.presets import config_folder

    facts: dict[str, Any] = dict(build_fingerprint())
    core = ("scipy", "click", "rich", "PyYAML", "jsonschema")
    extras = (
        "mcap",
        "rosbags",
        "paho-mqtt",
        "asyncua",
        "starlette",
        "uvicorn",
        "rerun-sdk",
        "matplotlib",
        "pyarrow",
        "Jinja2",
        "distributed",
        "rclpy",
    )
    for name in (*core, *extras):
        try:
            facts[name] = version(name)
        except PackageNotFoundError:
            facts[name] = "not installed"
    return facts | {"presets": ", ".join(PRESETS), "configuration": str(config_folder())}


def _scene(target: str, as_json: bool) -> int:
    from plow_twin.cli.scene_facts import derived, numbers
    from plow_twin.scene_file import load_scene

    scene = load_scene(target)
    rows, facts = numbers(scene), derived(scene)
    if as_json:
        click.echo(json.dumps({"numbers": rows, "derived": facts}, indent=2))
        return DONE
    console = output_console()
    _print_numbers(console, target, rows)
    follows = table("derived quantities", "quantity", "value", "unit")
    for fact in facts:
        follows.add_row(fact["quantity"], f"{fact['value']:.6g}", fact["unit"])
    console.print(follows)
    return DONE


def _print_numbers(console: Console, target: str, rows: Sequence[dict[str, Any]]) -> None:
    sources = list(dict.fromkeys(row["source"] for row in rows if row["source"]))
    stated = table(f"{target}: numbers", "number", "value", "unit", "mark, source")
    section = ""
    for row in rows:
        name, _, key = row["key"].partition(".")
        if name != section:
            stated.add_section()
            stated.add_row(Text(name, "bold"))
            section = name
        mark = f"{row['mark']} {1 + sources.index(row['source']):2}" if row["source"] else row["mark"]
        stated.add_row(f"  {key}", f"{row['value']:g}", row["unit"], mark)
    console.print(stated)
    for index, source in enumerate(sources, 1):
        console.print(Padding(f"{index:2}: {source}", (0, 0, 0, 2)), highlight=False)


def _recording(path: Path, as_json: bool) -> int:
    from plow_twin.cli.recording_facts import read_recording

    facts, lossy = read_recording(path)
    _show(facts, as_json)
    say_end(path, facts["status"])
    return DONE_WITH_LOSS if lossy else DONE


def _unused(path: Path, as_json: bool) -> int:
    from plow_twin.record.unused import unused_messages

    table = csv.writer(sys.stdout, lineterminator="\n")
    if not as_json:
        table.writerow(("input", "sender", "reason", "count", "stamp_ns", "values"))
    for found in unused_messages(path):
        if as_json:
            values = [value if math.isfinite(value) else repr(value) for value in found["values"]]
            click.echo(json.dumps(found | {"values": values}))
        else:
            table.writerow((found | {"values": " ".join(map(repr, found["values"]))}).values())
    return DONE
