"""`plow-twin info`: what a scene, a recording or this installation is made of."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from plow_twin.cli.console import DONE, DONE_WITH_LOSS, json_option, output_console, table
from plow_twin.scene_file.presets import PRESETS


@click.command(epilog="Exit codes: 0 done, 1 failed, 2 wrong usage or scene, 3 a recording with loss.")
@click.argument("target", required=False)
@json_option
def info(target: str | None, as_json: bool) -> int:
    """Describe TARGET: a scene (file or preset) or a recording (.mcap); without it, this installation."""
    if target is None:
        return _show(_environment(), as_json)
    if Path(target).suffix == ".mcap" or Path(target).is_dir():
        return _recording(Path(target), as_json)
    return _scene(target, as_json)


def _show(facts: dict[str, Any], as_json: bool) -> int:
    if as_json:
        click.echo(json.dumps(facts, indent=2))
        return DONE
    console = output_console()
    for key, value in facts.items():
        console.print(f"{key:24} {value}", highlight=False, soft_wrap=True)
    return DONE


def _environment() -> dict[str, Any]:
    from importlib.metadata import PackageNotFoundError, version

    from plow_twin.build import build_fingerprint
    from plow_twin.scene_file.presets import config_folder

    facts: dict[str, Any] = dict(build_fingerprint())
    core = ("scipy", "click", "rich", "PyYAML", "jsonschema")
    extras = ("mcap", "rosbags", "rerun-sdk", "matplotlib", "pyarrow", "Jinja2", "distributed", "rclpy")
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
    marks = table(f"{target}: what is stated", "number", "value", "unit", "mark")
    marks.add_column("source")
    for row in rows:
        marks.add_row(row["key"], f"{row['value']:g}", row["unit"], row["mark"], row["source"])
    console.print(marks)
    follows = table("what follows", "quantity", "value", "unit")
    for fact in facts:
        follows.add_row(fact["quantity"], f"{fact['value']:.6g}", fact["unit"])
    console.print(follows)
    return DONE


def _recording(path: Path, as_json: bool) -> int:
    from plow_twin.cli.recording_facts import read_recording

    facts, lossy = read_recording(path)
    _show(facts, as_json)
    return DONE_WITH_LOSS if lossy else DONE
