"""Options that several verbs of `plow-twin study` use."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from plow_twin.model.scene import Scene

set_option = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="PATH=VALUE",
    help="New value of a number or a word in the scene; may be repeated.",
)


@contextmanager
def usage_errors() -> Iterator[None]:
    """Convert errors in the arguments of a study to usage errors, which have the exit code 2."""
    from plow_twin.study.parameters import StudyError

    try:
        yield
    except StudyError as error:
        raise click.UsageError(str(error)) from None


def study_scene(name: str, settings: Sequence[str]) -> Scene:
    """Load a scene, and apply the changes of the option `--set`.

    Raise `StudyError` or `SceneError` if the scene or a change is invalid.
    """
    from plow_twin.scene_file import load_scene
    from plow_twin.study.parameters import parse_settings, with_parameters

    scene = load_scene(name)
    return with_parameters(scene, parse_settings(scene, settings)) if settings else scene
