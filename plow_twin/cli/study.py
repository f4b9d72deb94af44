"""The command group `plow-twin study`, whose commands simulate many runs."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Final

import click

from plow_twin.cli.study_calibrate import calibrate
from plow_twin.cli.study_sweep import sweep
from plow_twin.errors import PlowTwinError

CLONE: Final = Path(__file__).resolve().parents[2] / "studies" / "paper"


@click.group(
    short_help="Studies of many runs: sweeps, calibration, the paper.",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage or scene, 3 done with counted loss.",
)
def study() -> None:
    """Run studies that need many simulations: sweeps, calibration, the paper."""


def paper_command() -> click.Command:
    """Return the verb `paper` of the package `plow_twin_paper`, or a verb that explains how to install the package."""
    if CLONE.is_dir() and str(CLONE) not in sys.path:
        sys.path.append(str(CLONE))
    try:
        command: click.Command = import_module("plow_twin_paper.command").paper
    except ModuleNotFoundError as error:
        if error.name != "plow_twin_paper":
            raise
        return _absent_paper()
    return command


def _absent_paper() -> click.Command:
    @click.command("paper", short_help="Not installed.", context_settings={"ignore_unknown_options": True})
    @click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
    def paper(arguments: tuple[str, ...]) -> int:
        """Compute the figures and numbers of the paper again (not installed, see `studies/paper` of the repository)."""
        raise PlowTwinError(
            "study paper: plow_twin_paper is not installed; run it from a clone, or there: pip install ./studies/paper"
        )

    return paper


_VERBS: tuple[click.Command, ...] = (sweep, calibrate, paper_command())
for _verb in _VERBS:
    study.add_command(_verb)
