"""Running-in of a pad. The wear coefficient of a new pad is high, and decreases with the wear depth h.

The wear coefficient is k_s (1 + (r - 1) exp(-h / h0)). Let z be the depth to which k_s alone would have worn the pad.
Then

    h = z + h0 ln(r - (r - 1) exp(-z / h0))        z = h + h0 ln((1 + (r - 1) exp(-h / h0)) / r)

Under a constant force F, z grows with the sliding distance s as z = k_s F s / A, and the coefficient approaches k_s as
exp(-s / s0) with s0 = h0 A / (k_s F), the exponential transient of Queener, Smith and Mitchell, Wear 8 (1965) 391.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.scene import Wear

Array = NDArray[np.float64]


def without_running_in(wear: Wear, depth: Array) -> Array:
    """Return the depth z [m] that a pad of depth h [m] would have with k_s alone."""
    if wear.running_in_depth_m is None or wear.running_in_ratio == 1.0:
        return depth
    ratio, h0 = wear.running_in_ratio, wear.running_in_depth_m
    steady: Array = depth + h0 * np.log((1.0 + (ratio - 1.0) * np.exp(-depth / h0)) / ratio)
    return steady


def with_running_in(wear: Wear, steady: Array) -> Array:
    """Return the depth h [m] of a pad for the depth z [m] (`steady`), the inverse of `without_running_in`."""
    if wear.running_in_depth_m is None or wear.running_in_ratio == 1.0:
        return steady
    ratio, h0 = wear.running_in_ratio, wear.running_in_depth_m
    depth: Array = steady + h0 * np.log(ratio - (ratio - 1.0) * np.exp(-steady / h0))
    return depth
