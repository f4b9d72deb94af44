"""Select the publications to record.

The impulses and peaks of an omitted publication are added to the next recorded publication.
"""

from __future__ import annotations

import numpy as np

from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.stream.outputs import Published


class Decimation:
    """Selection of the publications to record.

    The argument `outputs` is `all`, `decimated` or `none`. With `decimated`, the first publication in each period of
    the rate `rate_hz` [Hz] is recorded, and every publication with a slow part is recorded.
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
        """Return the publication to record, or None if `published`, which has one row, is omitted."""
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
