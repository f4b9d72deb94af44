"""Simulated machines for the tests of the estimate. Two of them are estimated once for all tests of a process."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache

from scenes import ROOT
from shared_work import computed_once

from plow_twin.estimate.estimate import estimate
from plow_twin.estimate.result import Estimate

sys.path.insert(0, str(ROOT / "benchmark"))
from estimate_mismatch import KINDS, Mismatch
from estimate_mismatch import draw as mismatched
from estimate_truths import GROUPS, Truth, draw

__all__ = ["GROUPS", "KINDS", "Mismatch", "Truth", "draw", "known", "mismatched"]


@cache
def known() -> tuple[tuple[Truth, Estimate], ...]:
    """Return two simulated machines with the paper's scene over five load periods, with their estimates."""
    return computed_once("known machines", _known)


def _known() -> tuple[tuple[Truth, Estimate], ...]:
    truths = [draw(replace(GROUPS["plain"], periods=5.0), seed) for seed in (2, 3)]
    return tuple((truth, estimate(truth.nominal, truth.load, truth.poses)) for truth in truths)
