"""Selection of the publications to record: all, none, or some; these include the impulses and peaks of the rest."""

from __future__ import annotations

import numpy as np

from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.stream.outputs import Published


class Decimation:
    """Thin publications out.

    Parameters
    ----------
    outputs
        `all`, `decimated` or `none`.
    rate_hz
        Rate of a decimated recording [Hz]: the first publication of each period and each publication with a slow part
        are kept.
    """

    def __init__(self, outputs: str, rate_hz: float) -> None:
        self._outputs = outputs
        self._span_ns = max(1, round(1e9 / rate_hz))
        self._kept: int | None = None
        self._impulse = np.zeros(PAIR_COUNT)
        self._peak = np.zeros(PAIR_COUNT)

    @property
    def keeps_all(self) -> bool:
        """Whether every publication is recorded."""
        return self._outputs == "all"

    def select(self, published: Published) -> Published | None:
        """Return the publication to record, or None, given a publication of one row."""
        if self._outputs == "all":
            return published
        if self._outputs == "none":
            return None
        rows, slow = published
        self._impulse += rows["impulse"][0]
        np.maximum(self._peak, rows["peak"][0], out=self._peak)
        span = int(rows["stamp_ns"][0]) // self._span_ns
        if span == self._kept and not len(slow):
            return None
        self._kept, rows = span, rows.copy()
        rows["impulse"], rows["peak"] = self._impulse, self._peak
        self._impulse[:] = 0.0
        self._peak[:] = 0.0
        return Published(rows, slow)
