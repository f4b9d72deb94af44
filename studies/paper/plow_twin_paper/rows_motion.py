"""Rows of Fig. 6 (motion) and Fig. 7 (force at each point)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from plow_twin.model.scene import Scene
from plow_twin.run.simulate import Result
from plow_twin_paper import sets as paper_sets
from plow_twin_paper.rows import CHECK, FITTED, Row, Verdict
from plow_twin_paper.values import (
    CORNERS,
    FORCE_TOLERANCE,
    FORCES,
    FORCES_SOURCE,
    PERIOD_S,
    SENSE_NAMES,
    Sense,
)

_MOTION: Final = "Motion (Fig. 6)"
_FORCES: Final = "Force at each point (Fig. 7)"
_MEAN_OVER: Final = "; mean over the time in contact (the paper does not say over what)"
_STATISTICS: Final = {"max": "largest force", "mean_in_contact": "largest mean force"}


def rows(scene: Scene, result: Result) -> list[Row]:
    """Return the rows of Figs 6 and 7 for one run."""
    table = force_table(scene, result)
    return [*_motion(result), _intermittent(scene, result), *_largest(table), *_order(table)]


def force_table(scene: Scene, result: Result) -> dict[tuple[Sense, str], dict[str, float]]:
    """Return the forces [N] of each corner for each direction of swing: largest force and means."""
    letters, pairs = paper_sets.letters_of_pairs(scene), list(result.statistics.values())
    return {
        (sense, letter): dict(pairs[pair])
        for sense in SENSE_NAMES
        for pair, letter in enumerate(letters)
        if paper_sets.of_sense(sense)[pair]
    }


def _motion(result: Result) -> Iterator[Row]:
    source = "section 3, Fig. 6; section 6 (1)"
    periods = float(result.t[-1]) / PERIOD_S
    for column, name in enumerate(("x", "y", "theta")):
        turns = int((np.diff(np.sign(result.v[:, column][np.abs(result.v[:, column]) > 0.0])) != 0).sum())
        yield Row(
            _MOTION, source, f"{name} oscillates beyond the load's own swing", "oscillates",
            f"turns {turns / periods:.0f} times in a period of the load", Verdict.of(turns / periods > 2.0),
            "turns more than twice in a period of the load", CHECK,
        )  # fmt: skip
    up, down = 1e3 * float(result.q[:, 1].max()), -1e3 * float(result.q[:, 1].min())
    yield Row(
        _MOTION, "section 3, Fig. 6", "y swings further down than up, for gravity", "further down",
        f"{down:.1f} mm down, {up:.1f} mm up", Verdict.of(down > up), "largest -y above largest y", CHECK,
    )  # fmt: skip


def _intermittent(scene: Scene, result: Result) -> Row:
    table = force_table(scene, result)
    duration = float(result.t[-1])
    makes = {
        letter: (sum(int(table[sense, letter]["makes"]) for sense in SENSE_NAMES)) / (duration / PERIOD_S)
        for letter in CORNERS
    }
    shares = [table[sense, letter]["time_in_contact"] / duration for sense in SENSE_NAMES for letter in CORNERS]
    return Row(
        _FORCES, FORCES_SOURCE, "every point meets the head intermittently", "all of a, b, c, d",
        ", ".join(f"{letter} {value:.1f}" for letter, value in makes.items())
        + f" makes a period; a sense carries {min(shares):.0%} to {max(shares):.0%} of the time",
        Verdict.of(min(makes.values()) >= 1.0 and max(shares) < 1.0),
        "each point is touched at least once a period, and no point is held all the time", CHECK,
    )  # fmt: skip


def _largest(table: dict[tuple[Sense, str], dict[str, float]]) -> Iterator[Row]:
    for force in FORCES:
        values = {letter: table[force.sense, letter][force.statistic] for letter in CORNERS}
        first = max(values, key=lambda letter: values[letter])
        title = f"{SENSE_NAMES[force.sense]}: {_STATISTICS[force.statistic]}"
        listed = ", ".join(f"{letter} {value / 1e3:.2f}" for letter, value in values.items())
        yield Row(
            _FORCES, FORCES_SOURCE, f"{title} is at {force.corner}", f"at {force.corner}", f"at {first} ({listed} kN)",
            Verdict.of(first == force.corner), "the same point", FITTED,
        )  # fmt: skip
        value = values[force.corner]
        yield Row(
            _FORCES, FORCES_SOURCE, f"{title}, at {force.corner}", f"{force.value_n / 1e3:.0f}", f"{value / 1e3:.2f}",
            Verdict.of(abs(value - force.value_n) <= FORCE_TOLERANCE * force.value_n),
            f"within {FORCE_TOLERANCE:.0%}{_MEAN_OVER if force.statistic == 'mean_in_contact' else ''}",
            FITTED, "kN", force.value_n / 1e3, value / 1e3,
        )  # fmt: skip


def _order(table: dict[tuple[Sense, str], dict[str, float]]) -> Iterator[Row]:
    for statistic, name in (("max", "largest"), ("mean_in_contact", "mean")):
        values = {letter: max(table[sense, letter][statistic] for sense in SENSE_NAMES) for letter in CORNERS}
        listed = ", ".join(f"{letter} {value / 1e3:.1f}" for letter, value in values.items())
        for letter in ("a", "b"):
            yield Row(
                _FORCES, FORCES_SOURCE, f"{letter} is loaded more than c and d, {name} force", f"{letter} > c, d",
                f"{listed} kN", Verdict.of(values[letter] > max(values["c"], values["d"])),
                "the larger of a point's two senses above those of c and d", FITTED,
            )  # fmt: skip
