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
        facts, lossy = read_recording(Path(target))
        _show(facts, as_json)
        say_end(target, facts["status"])
        return DONE_WITH_LOSS if lossy else DONE
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
    extras = "mcap rosbags paho-mqtt asyncua starlette uvicorn rerun-sdk matplotlib pyarrow Jinja2 distributed rclpy"
    for name in ("scipy", "click", "rich", "PyYAML", "jsonschema", *extras.split()):
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


def read_recording(path: Path) -> tuple[dict[str, Any], bool]:
    """Return a summary of a recording, and whether it is incomplete or has losses or failed advances.

    Raise `RecordingError` if the file is not a recording of plow_twin.
    """
    from plow_twin.record.reader import FileStatus, RunReader
    from plow_twin.record.run_time import RunTime
    from plow_twin.record.unused import InputCounts
    from plow_twin.stream.journal import Failed

    reader = RunReader(path)
    header = reader.header
    inputs, run_time, failed = InputCounts(header.excitation_source), RunTime(header.parameters), 0
    for batch in reader.batches():
        inputs.add(batch.entries)
        run_time.add(batch.entries)
        failed += sum(entry.advances for entry in batch.entries.rest.values() if isinstance(entry, Failed))
    facts: dict[str, Any] = {
        "file": str(reader.path),
        "status": reader.status.value,
        "stop_reason": reader.stop_reason,
        "duration_s": run_time.span_s,
        "without_samples": run_time.silences.facts(),
        "messages": dict(sorted(reader.counts.items())),
        "inputs": inputs.facts(),
        "failed_advances": failed,
        "lost": {**reader.lost, **reader.lost_parts},
        "damaged_chunks": reader.damaged_chunks,
        "foreign_parts": {file.name: list(keys) for file, keys in reader.foreign.items()},
        "run_id": header.run_id,
        "package_version": header.package_version,
        "node": header.node,
        "excitation_source": header.excitation_source,
        "tol": header.tol,
        "clock": header.clock,
        "origin_ns": header.origin_ns,
        "build": dict(header.build),
        "parameters": dict(header.parameters),
    }
    return facts, bool(facts["lost"] or failed) or reader.status is not FileStatus.COMPLETE


def _unused(path: Path, as_json: bool) -> int:
    from plow_twin.record.unused import unused_messages

    table = csv.writer(sys.stdout, lineterminator="\n")
    if not as_json:
        table.writerow(("input", "sender", "reason", "count", "stamp_ns", "values"))
    for unused in unused_messages(path):
        if as_json:
            values = [value if math.isfinite(value) else repr(value) for value in unused["values"]]
            click.echo(json.dumps(unused | {"values": values}))
        else:
            table.writerow((unused | {"values": " ".join(map(repr, unused["values"]))}).values())
    return DONE
