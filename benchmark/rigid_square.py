"""The square as a rigid body: impacts of one corner at a time by Routh's method, with Poisson's restitution.

Flights, rounded corners and marker are those of the compliant block, so that the two models differ only in the contact.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from plow_twin.study.measured.square import RATE_HZ

#: Time step [s], in which a corner moves at most 0.5 mm.
STEP = 2e-4
#: Increment of the normal impulse per mass in Routh's integration [m/s].
BIT = 5e-3
Impact = Callable[..., tuple[np.ndarray, np.ndarray]]


def rigid_toss(initial: np.ndarray, rows: int, block: np.ndarray, impact: Impact, e: float, mu: float) -> np.ndarray:
    """Return the motions of m rigid blocks at 250 Hz, shape (m, rows, 6), given their initial states, shape (m, 6)."""
    z = initial.copy()
    states = np.zeros((len(z), rows, 6))
    states[:, 0] = z
    drag = np.array([block["drag"], block["drag"], block["spin_drag"]])
    each = round(1.0 / (RATE_HZ * STEP))
    for row in range(1, rows):
        for _ in range(each):
            rate = -drag * z[:, 3:] - [0.0, float(block["gravity"]), 0.0]
            z[:, :3] += (z[:, 3:] + 0.5 * STEP * rate) * STEP
            z[:, 3:] += STEP * rate
            _hit(z, block, impact, e, mu)
        states[:, row] = z
    return states


def deepest(z: np.ndarray, block: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the depth of each corner [m], and the arms (across, up) of its lowest point, shape (m, 4) each."""
    signs = np.array([[1.0, -1.0, -1.0, 1.0], [1.0, 1.0, -1.0, -1.0]]) * float(block["half"])
    c, s = np.cos(z[:, 2:3]), np.sin(z[:, 2:3])
    across, up = c * signs[0] - s * signs[1], s * signs[0] + c * signs[1] - float(block["radius"])
    return float(block["table"]) - z[:, 1:2] - up, across, up


def _hit(z: np.ndarray, block: np.ndarray, impact: Impact, e: float, mu: float) -> None:
    """Apply an impact to each corner below the table's surface that moves down, in order of decreasing depth."""
    inertia = float(block["gyration"]) ** 2
    for _ in range(4):
        depth, across, up = deepest(z, block)
        rate = z[:, 4:5] + across * z[:, 5:6]
        chosen = np.where(rate < 0.0, depth, -1.0)
        corner = chosen.argmax(axis=1)
        hits = np.flatnonzero(chosen[np.arange(len(z)), corner] > 0.0)
        if not len(hits):
            return
        ax, az = across[hits, corner[hits]], up[hits, corner[hits]]
        slip, approach = z[hits, 3] - z[hits, 5] * az, z[hits, 4] + z[hits, 5] * ax
        along, away = impact(
            slip, approach, 1.0 + az**2 / inertia, 1.0 + ax**2 / inertia, -ax * az / inertia, e, mu, BIT
        )
        z[hits, 3] += along
        z[hits, 4] += away
        z[hits, 5] += (ax * away - az * along) / inertia


def two_at_once(tossed: np.ndarray, rows: np.ndarray, block: np.ndarray, within: float) -> np.ndarray:
    """Return a mask of the motions, rows every 0.25 ms, in which two corners touch within a time `within` [s]."""
    double = np.zeros(len(tossed), bool)
    width = math.ceil(within * 16.0 * RATE_HZ)
    for index, motion in enumerate(tossed):
        touching = deepest(motion[: rows[index]], block)[0] > 0.0
        near = np.lib.stride_tricks.sliding_window_view(touching, width, axis=0).any(axis=-1)
        double[index] = bool((near.sum(axis=1) > 1).any())
    return double
