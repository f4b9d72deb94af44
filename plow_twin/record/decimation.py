"""Which publications a recording keeps: all, none, or some with the impulses and peaks of those left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.stream.outputs import Publication


class Decimation:
    """Thin publications out.

    Parameters
    ----------
    outputs
        `all`, `decimated` or `none`.
    rate_hz
        Rate of a decimated recording [Hz]: the first publication in each such span of stamps is kept, and each that
        has a slow part.
    """

    def __init__(self, outputs: str, rate_hz: float) -> None:
        self._outputs = outputs
        self._span_ns = max(1, round(1e9 / rate_hz))
        self._kept: int | None = None
        self._impulse = np.zeros(PAIR_COUNT)
        self._peak = np.zeros(PAIR_COUNT)

    def take(self, publication: Publication) -> Publication | None:
        """Return what to record now, or None."""
        if self._outputs == "all":
            return publication
        if self._outputs == "none":
            return None
        self._impulse += publication.impulse
        np.maximum(self._peak, publication.peak, out=self._peak)
        span = publication.stamp_ns // self._span_ns
        if span == self._kept and publication.slow is None:
            return None
        self._kept = span
        kept = replace(publication, impulse=self._impulse.copy(), peak=self._peak.copy())
        self._impulse[:] = 0.0
        self._peak[:] = 0.0
        return kept
