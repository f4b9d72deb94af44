"""All figures of the report, each with a description of the paper's figure and of its own content."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plow_twin_paper.runs import PaperRuns
from plow_twin_paper.values import CORNERS

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Picture:
    """A picture file with its heading, a description of the paper's figure, and a description of the picture."""

    path: Path
    heading: str
    paper: str
    here: str


def draw_all(runs: PaperRuns, scene: str, folder: Path, on_progress: Callable[[float], object]) -> list[Picture]:
    """Draw all figures into a folder as PNG. Return them in the order of the paper."""
    from plow_twin_paper.style import save

    pictures = []
    plans = _plans(runs)
    for index, (name, heading, paper, here, draw) in enumerate(plans):
        path = folder / f"{name}.png"
        save(draw(), path, heading, scene)
        pictures.append(Picture(path, heading, paper, here))
        on_progress((index + 1) / len(plans))
    return pictures


def _plans(runs: PaperRuns) -> list[tuple[str, str, str, str, Callable[[], Figure]]]:
    from plow_twin_paper import figures_motion as motion
    from plow_twin_paper import figures_trends as trends

    scene = runs.scene.clearance
    case = f"{1e3 * scene.horizontal_m:g} mm horizontal, {1e3 * scene.vertical_m:g} mm vertical clearance"
    return [
        (
            "paper_fig06", "Fig. 6: motion of the head",
            "x, y and theta in time; all oscillate, y further down than up.", case, lambda: motion.fig06(runs),
        ),
        (
            "paper_fig07", "Fig. 7: force at each point",
            "Force of each point, intermittent; the text gives the largest and the largest mean of each sense.",
            f"{case}; black: published values at the points that the paper names.", lambda: motion.fig07(runs),
        ),
        (
            "paper_fig08", "Fig. 8: counter-clockwise contacts, close-up",
            "One, two and three points carry force, two most often; three sets are quoted at their times.",
            "Vertical lines: the quoted times.", lambda: motion.close_up(runs, "ccw"),
        ),
        (
            "paper_fig09", "Fig. 9: clockwise contacts, close-up",
            "One, two and three points carry force; three sets are quoted at their times.",
            "Vertical lines: the quoted times.", lambda: motion.close_up(runs, "cw"),
        ),
        (
            "paper_fig10", "Fig. 10: largest force against the vertical clearance",
            "Every point's largest force rises, then falls; the largest is at a or b.", "Runs as long as the case's.",
            lambda: trends.trend(runs.vertical, "vertical", "horizontal"),
        ),
        (
            "paper_fig11", "Fig. 11: largest force against the horizontal clearance",
            "Every point's largest force rises; the largest is at a or b.", _falls(runs),
            lambda: trends.trend(runs.horizontal, "horizontal", "vertical"),
        ),
        (
            "paper_fig13", "Fig. 13: contact of the four inner faces",
            "RecurDyn, 20 s: (1) counter-clockwise one face, (2) clockwise two, (3) clockwise three faces in contact.",
            f"{case} (not stated in the paper); a corner has one pair in each sense, each with another wall, so that "
            "as many faces touch as points carry force.", lambda: trends.fig13(runs),
        ),
        (
            "paper_fig14", "Fig. 14: inner faces, vertical clearance 20, 25, 30 mm",
            "RecurDyn: the trend of Fig. 10.", "Horizontal clearance 20 mm (assumed, as in Fig. 10).",
            lambda: trends.faces(runs.faces_vertical, "vertical"),
        ),
        (
            "paper_fig15", "Fig. 15: inner faces, horizontal clearance 20, 25, 30 mm",
            "RecurDyn: the trend of Fig. 11.", "Vertical clearance 20 mm (assumed, as in Fig. 11).",
            lambda: trends.faces(runs.faces_horizontal, "horizontal"),
        ),
    ]  # fmt: skip


def _falls(runs: PaperRuns) -> str:
    """Return a sentence with the largest decrease of each curve in Fig. 11 from an earlier maximum."""
    forces = runs.horizontal.largest_n
    falls = np.max(np.maximum.accumulate(forces, axis=0) - forces, axis=0)
    listed = ", ".join(f"{corner} {1e-3 * fall:.1f}" for corner, fall in zip(CORNERS, falls, strict=True))
    return f"Not monotonic between the marks: the deepest falls below a value reached before are {listed} kN."


def draw_rotation(runs: PaperRuns, scene: str, folder: Path) -> Picture | None:
    """Draw the three models of rotation. Return None if gravity has no arm."""
    from plow_twin_paper.figures_trends import rotation_figure
    from plow_twin_paper.style import save

    if runs.rotation is None:
        return None
    path, heading = folder / "paper_rotation.png", "Constant moment and exact rigid body"
    save(rotation_figure(runs.rotation), path, heading, scene)
    return Picture(path, heading, "", "")
