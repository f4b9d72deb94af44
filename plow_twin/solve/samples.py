"""Conversion of load samples to model times and to loads per mass and inertia, for the kernels."""

from __future__ import annotations

import math

from plow_twin.kernel.compiler import kernel


@kernel(entry=True)
def lay_out(before, samples, inertias, per) -> bool:
    """Write the load sample `before`, shape (3,), and n new samples, divided by mass and inertia, to `per`.

    Returns whether all new samples are finite.
    """
    finite = True
    for j in range(3):
        per[0, j] = before[j] / inertias[j]
        for n in range(len(samples)):
            finite = finite and math.isfinite(samples[n, j])
            per[n + 1, j] = samples[n, j] / inertias[j]
    return finite


@kernel(entry=True)
def model_times(stamps, origin_ns, times) -> None:
    """Write the model times [s] that belong to the stamps [ns], shape (n,), to `times`."""
    for n in range(len(stamps)):
        times[n] = (stamps[n] - origin_ns) * 1e-9
