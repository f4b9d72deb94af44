"""Draw the random scenes again and run their references; this needs gcc with libquadmath."""

from __future__ import annotations

import click
import random_scenes
from rich.progress import Progress


@click.command()
def main() -> None:
    """Write benchmark/data/random_scenes.npz."""
    with Progress() as progress:
        task = progress.add_task("references", total=random_scenes.COUNT)
        random_scenes.make(lambda: progress.update(task, advance=1))
    click.echo(str(random_scenes.DATA))


if __name__ == "__main__":
    main()
