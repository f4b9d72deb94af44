"""The systemd units of `config`: their clean-up removes the oldest runs, and their options exist."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path

import pytest
from scenes import ROOT

from plow_twin.cli.app import commands
from plow_twin.live.parameters import SPECS

UNITS = ("plow_twin.service", "plow_twin_live.service")
MB = 1_000_000


def command(unit: str, key: str) -> list[str]:
    """Return the words of a command of a unit, without the prefix for failures and with `$$` as `$`."""
    text = (ROOT / "config" / unit).read_text().replace("\\\n", "")
    (line,) = re.findall(rf"^{key}=-?(.*)$", text, re.MULTILINE)
    return shlex.split(line.replace("$$", "$"))


@pytest.mark.parametrize("unit", UNITS)
def test_the_clean_up_removes_the_oldest_runs(unit: str, tmp_path: Path) -> None:
    def clean() -> list[str]:
        words = [word.replace("/var/lib/plow_twin", str(tmp_path)) for word in command(unit, "ExecStartPre")]
        assert words[-1].count("20000") == 1
        subprocess.run([*words[:-1], words[-1].replace("20000", "6")], check=True)
        return sorted(path.name for path in (tmp_path / "runs").glob("*"))

    assert clean() == []  # without runs, there is nothing to remove
    for number, name in enumerate(("run_2", "run of a name with spaces", "run")):
        folder = tmp_path / "runs" / name
        folder.mkdir(parents=True)
        (folder / "run_0.mcap").write_bytes(bytes(3 * MB))
        subprocess.run(["touch", "-d", f"2026-01-0{1 + number}", folder], check=True)
    assert clean() == ["run", "run of a name with spaces"]
    assert clean() == ["run", "run of a name with spaces"]


def test_the_units_use_existing_options_and_parameters() -> None:
    words = command("plow_twin_live.service", "ExecStart")
    valid = {option for parameter in commands.commands["live"].params for option in parameter.opts}
    assert words[1] == "live" and {word for word in words if word.startswith("--")} <= valid
    for unit, option in (("plow_twin.service", "-p"), ("plow_twin_live.service", "--set")):
        named = re.findall(rf" {option} (\w+):?=", " ".join(command(unit, "ExecStart")))
        assert named and {*named} <= SPECS.keys()
