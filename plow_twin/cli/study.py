"""`plow-twin study`: questions that take many runs."""

from __future__ import annotations

import click

from plow_twin.cli.study_calibrate import calibrate
from plow_twin.cli.study_paper import paper
from plow_twin.cli.study_sweep import sweep


@click.group(
    short_help="Sweeps, calibration and the paper: what takes many runs.",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage or scene, 3 done with counted loss.",
)
def study() -> None:
    """Ask questions that take many runs: sweeps, calibration, the paper."""


# each verb lives in a module of its own, plow_twin/cli/study_<verb>.py, and is added here
_VERBS: tuple[click.Command, ...] = (sweep, calibrate, paper)
for _verb in _VERBS:
    study.add_command(_verb)
