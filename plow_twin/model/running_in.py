"""Running-in: a new pad wears faster; the excess falls with the wear depth h as exp(-h / h0).

With the coefficient k_s (1 + (r - 1) exp(-h / h0)) a pad whose wear depth would be z with k_s alone has the depth

    h = z + h0 ln(r - (r - 1) exp(-z / h0))        z = h + h0 ln((1 + (r - 1) exp(-h / h0)) / r)

h0 ln r deeper in the end. At constant force z grows with the sliding distance s, z = k_s F s / A, and the coefficient
reaches its steady value as exp(-s / s0) with s0 = h0 A / (k_s F): a transient that dies away exponentially with the
distance (Queener, Smith and Mitchell, Wear 8 (1965) 391). As a function of the depth it needs no state of its own: it
continues from a saved depth, and starts again with new pads.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.scene import Wear

Array = NDArray[np.float64]


def without_running_in(wear: Wear, depth: Array) -> Array:
    """Return z in m, the depth [m] at the steady coefficient from new: z(0) = 0."""
    if wear.running_in_depth_m is None or wear.running_in_ratio == 1.0:
        return depth
    ratio, h0 = wear.running_in_ratio, wear.running_in_depth_m
    steady: Array = depth + h0 * np.log((1.0 + (ratio - 1.0) * np.exp(-depth / h0)) / ratio)
    return steady


def with_running_in(wear: Wear, steady: Array) -> Array:
    """Return the depth h in m that goes with z in m; inverse of `without_running_in`."""
    if wear.running_in_depth_m is None or wear.running_in_ratio == 1.0:
        return steady
    ratio, h0 = wear.running_in_ratio, wear.running_in_depth_m
    depth: Array = steady + h0 * np.log(ratio - (ratio - 1.0) * np.exp(-steady / h0))
    return depth
