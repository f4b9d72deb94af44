"""Conversion of samples to the units of the kernels: model times, and loads per mass and inertia."""

from __future__ import annotations

import math

from plow_twin.kernel.compiler import kernel


@kernel(entry=True)
def lay_out(before, samples, inertias, per) -> bool:
    """Divide the wrenches of samples by mass and inertia, and write them to `per`, shape (n + 1, 3).

    `samples` are the new samples, shape (n, 3); `before` is the previous sample, shape (3,). Returns whether all new
    samples are finite.
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
    """Write the model times [s] of stamps [ns], shape (n,), to `times`."""
    for n in range(len(stamps)):
        times[n] = (stamps[n] - origin_ns) * 1e-9
