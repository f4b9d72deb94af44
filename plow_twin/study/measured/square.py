"""Drops of a square block: a fit of the first flight, and bands of the motion that follows.

A *touch* is one contact of a corner with the table. Restitution, friction and the point of action vary randomly from
touch to touch, so the bands are quantiles of many random motions. A *marker* is the coordinate frame on the block that
the sensor tracks.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plow_twin.errors import ArgumentError
from plow_twin.model.contact_laws import LAWS
from plow_twin.solve.rounded_block import BLOCK, toss_blocks

Array = NDArray[np.float64]

#: Sample rate of the measured rows [Hz].
RATE_HZ: Final = 250.0
_DT: Final = 1.0 / RATE_HZ
_NUMBERS: Final = 1000
#: Number of touches for which random numbers are drawn. Later touches use the numbers of the last of these touches.
_TOUCHES: Final = 64
#: Smallest deviation [rad] that shows an impact, of an angle from the line through the three previous rows.
_TURN_IN_A_ROW: Final = 0.1
LEAST_ROWS: Final = 4
# largest number of rows of the bands (4 s; a block comes to rest within 1 s), and a speed [m/s] that no drop reaches
_MOST_ROWS, _FASTEST = 1000, 100.0

#: Parameters of the block, fitted to the odd-numbered drops.
SQUARE: Final = np.array(
    (0.02535, 0.00548, 0.0211, -2.4e-4, 1e8, 0.293, 0.039, 0.607, 0.228, 0.156, 0.179, 1.28, 9.81, 0.35, 0.73), BLOCK
)


@dataclass(frozen=True)
class Marker:
    """Place of the tracked coordinate frame on the block.

    The frame is not at the centre of the block: at rest, the tracked angle is not zero, and the tracked height depends
    on the side on which the block lies.
    """

    #: Measured angle minus true angle of the block [rad].
    turn: float = 0.0
    #: Vector [m] from the centre of the block to the tracked point, in the axes of the block.
    lever: tuple[float, float] = (0.0, 0.0)

    def state_of_block(self, measured: Array) -> Array:
        """Return the states of the block, shape (..., 6), given the states of its marker."""
        return self._moved(measured - [0.0, 0.0, self.turn, 0.0, 0.0, 0.0], -1.0)

    def measured(self, block: Array) -> Array:
        """Return the poses or states of the marker, shape (..., 3) or (..., 6), given those of the block."""
        turned = np.zeros(block.shape[-1])
        turned[2] = self.turn
        return self._moved(block, 1.0) + turned

    def _moved(self, block: Array, sign: float) -> Array:
        c, s = np.cos(block[..., 2]), np.sin(block[..., 2])
        x, y = (sign * value for value in self.lever)
        along, up = c * x - s * y, s * x + c * y
        moved: Array = block.copy()
        moved[..., 0] += along
        moved[..., 1] += up
        if block.shape[-1] > 3:
            moved[..., 3] -= block[..., 5] * up
            moved[..., 4] += block[..., 5] * along
        return moved


#: Place of the marker, fitted to the odd-numbered drops.
MARKER: Final = Marker(-0.0308, (2.3e-4, 5.2e-4))


@dataclass(frozen=True)
class Scatter:
    """Standard deviations of random parts of parameters, of fitted speeds, and of measured rows."""

    #: Variation from touch to touch: restitution [1], logarithm of the friction, and place along the table where the
    #: force acts [m].
    restitution: float = 0.065
    friction: float = 0.5
    shift: float = 1.5e-3
    #: Variation from drop to drop: height of the table [m], and logarithm of the drag.
    table: float = 3e-4
    drag: float = 0.2
    #: Errors of the fitted flight: speed [m/s], and angular velocity [rad/s].
    speed: float = 0.005
    spin: float = 0.05
    #: Errors of a measured row: place [m], and angle [rad].
    place: float = 6e-5
    angle: float = 1e-3


SCATTER: Final = Scatter()


@cache
def damping_numbers() -> Array:
    """Return the damping numbers D of `exact_restitution` for 1001 equally spaced restitutions 0..1, shape (1001,)."""
    law = LAWS["exact_restitution"]
    return np.array([law.damping_number(i / _NUMBERS) for i in range(_NUMBERS + 1)])


def toss(initial: Array, n_rows: int, blocks: NDArray[np.void], scatter: Array | None = None) -> Array:
    """Return the motions of m blocks at 250 Hz, shape (m, n_rows, 6), given their initial states, shape (m, 6).

    A state consists of x, z [m], theta [rad] and their rates. `blocks`, shape (m,), has the type
    `solve.rounded_block.BLOCK`. `scatter`, shape (m, touches, 3), is the argument of `toss_blocks`.
    """
    rows = np.zeros((len(initial), n_rows, 6))
    rows[:, 0] = initial
    more = np.zeros((len(initial), 1, 3)) if scatter is None else scatter
    toss_blocks(blocks, damping_numbers(), more, _DT, rows)
    return rows


@dataclass(frozen=True)
class Flight:
    """A fitted first flight."""

    #: State x, z, theta and their rates at the last row, shape (6,).
    state: Array
    #: Covariance of value and rate at the last row, for each of x, z and theta, shape (3, 2, 2).
    covariance: Array
    #: Times [s] of the rows relative to the last row, shape (k,). A lost row adds one interval.
    times: Array


def fit_flight(first_flight: ArrayLike, block: NDArray[np.void] = SQUARE, scatter: Scatter = SCATTER) -> Flight:
    """Fit a flight with drag to the rows before the first impact, by robustly weighted least squares.

    `first_flight`, shape (k, 3), contains rows x, z [m], theta [rad] at 250 Hz. Gravity and drag are those of `block`.
    The errors of a measured row are those of `scatter`. Raise `ArgumentError` if there are fewer than four rows, a
    number is not finite, or the rows are not a flight above the table.
    """
    try:
        rows = np.array(first_flight, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"first_flight: {error}, expected rows x, z, theta") from None
    if rows.ndim != 2 or rows.shape[1] != 3 or len(rows) < LEAST_ROWS or not np.isfinite(rows).all():
        raise ArgumentError(
            f"first_flight: got shape {rows.shape}, expected finite rows x, z, theta, at least {LEAST_ROWS} of them"
        )
    rows[:, 2] = np.unwrap(rows[:, 2])
    while len(rows) > LEAST_ROWS and _leaves_flight(rows):
        rows = rows[:-1]
    times = _row_times(rows, float(block["gravity"]))
    fastest = float(np.abs(np.diff(rows[:, :2], axis=0)).max()) * RATE_HZ
    if not (-times[0] < 2.0 * len(rows) * _DT and rows[:, 1].min() > 0.0 and fastest < _FASTEST):
        raise ArgumentError(
            f"first_flight: got {len(rows)} rows from z = {rows[0, 1]:.4g} to {rows[-1, 1]:.4g} m, at most "
            f"{fastest:.4g} m/s, expected a flight above the table at {RATE_HZ:g} Hz, below {_FASTEST:g} m/s"
        )
    state, covariance = np.zeros(6), np.zeros((3, 2, 2))
    noise = (scatter.place, scatter.place, scatter.angle)
    for j in range(3):
        way, fall = _free_flight(block, j, times)
        fitted, covariance[j] = _fit_line(way, rows[:, j] - fall, noise[j])
        state[[j, 3 + j]] = fitted
    return Flight(state, covariance, times)


def _free_flight(block: NDArray[np.void], axis: int, times: Array) -> tuple[Array, Array]:
    """Return the displacement at the times [s], shape (n,), of a flight with drag, as two parts of shape (n,).

    The first part is the displacement per unit of rate at time 0. The second part is the displacement by gravity.
    """
    drag = block["spin_drag" if axis == 2 else "drag"]
    way = (1.0 - np.exp(-drag * times)) / drag
    fall = -block["gravity"] / drag * (times - way) if axis == 1 else np.zeros_like(times)
    return way, fall


def _leaves_flight(rows: Array) -> bool:
    """Return whether the last row follows an impact: its angle deviates from a line, or it rises after a fall."""
    t = np.arange(-3.0, 1.0)
    turn = float(np.polyval(np.polyfit(t[:3], rows[-4:-1, 2], 1), t[3]))
    return bool(
        abs(rows[-1, 2] - turn) > _TURN_IN_A_ROW or (rows[-1, 1] - rows[-2, 1] > 0.0 > rows[-2, 1] - rows[-3, 1])
    )


def _row_times(rows: Array, gravity: float) -> Array:
    """Return the times [s] of the rows, shape (k,), with 0 at the last row.

    A lost row doubles the distance between its neighbours and is counted as an interval.
    """
    distance = np.hypot(*np.diff(rows[:, :2], axis=0).T)
    steps = np.ones(len(distance))
    for _ in range(3):
        at = np.concatenate([[0.0], np.cumsum(steps)])
        middle = 0.5 * (at[1:] + at[:-1]) * gravity * _DT * _DT
        expected = np.median(distance / steps - middle) + middle
        steps = np.maximum(np.round(distance / np.maximum(expected, 1e-6)), 1.0)
    at = np.concatenate([[0.0], np.cumsum(steps)])
    times: Array = (at - at[-1]) * _DT
    return times


def _fit_line(way: Array, values: Array, noise: float) -> tuple[Array, Array]:
    rows: Array = np.stack([np.ones_like(way), way], axis=1)
    weight: Array = np.ones_like(way)
    coefficients: Array = np.zeros(2)
    for _ in range(6):
        solved = np.linalg.lstsq(rows * weight[:, None], values * weight, rcond=None)[0]
        coefficients = np.asarray(solved, dtype=np.float64)
        weight = 1.0 / np.sqrt(1.0 + ((values - rows @ coefficients) / (3.0 * noise)) ** 2)
    spread = np.linalg.inv((rows * weight[:, None] ** 2).T @ rows)
    covariance = np.asarray(noise**2 * spread, dtype=np.float64)
    return coefficients, covariance


def draw(
    flight: Flight, members: int, seed: int, block: NDArray[np.void], scatter: Scatter
) -> tuple[Array, NDArray[np.void], Array]:
    """Draw initial states, shape (m, 6), blocks, shape (m,), and random parts of the touches, shape (m, touches, 3)."""
    rng = np.random.default_rng(seed)
    states = np.tile(flight.state, (members, 1))
    for j, more in enumerate((scatter.speed, scatter.speed, scatter.spin)):
        covariance = flight.covariance[j] + np.diag([0.0, more**2])
        states[:, [j, 3 + j]] += rng.multivariate_normal(np.zeros(2), covariance, members)
    blocks = np.tile(block, members)
    blocks["table"] += scatter.table * rng.standard_normal(members)
    blocks["drag"] *= np.exp(scatter.drag * rng.standard_normal(members))
    touches = rng.standard_normal((members, _TOUCHES, 3)) * [scatter.restitution, scatter.friction, scatter.shift]
    return states, blocks, touches


def ensemble(
    first_flight: ArrayLike,
    n_rows: int,
    *,
    members: int = 400,
    seed: int = 0,
    block: NDArray[np.void] = SQUARE,
    scatter: Scatter = SCATTER,
    marker: Marker = MARKER,
) -> Array:
    """Return random motions x, z, theta of the marker that continue the first flight, shape (members, n_rows, 3).

    The rows are counted from the first row of `first_flight`. See `fit_flight` for the remaining arguments.
    """
    flight = fit_flight(first_flight, block, scatter)
    measured_rows = len(flight.times)
    ahead = max(n_rows - measured_rows + 1, 1)
    states, blocks, touches = draw(flight, members, seed, block, scatter)
    tossed = marker.measured(toss(marker.state_of_block(states), ahead, blocks, touches)[:, :, :3])
    paths = np.empty((members, max(n_rows, measured_rows), 3))
    paths[:, measured_rows - 1 : measured_rows - 1 + ahead] = tossed
    for j in range(3):
        way, fall = _free_flight(block, j, flight.times[:-1])
        paths[:, : measured_rows - 1, j] = states[:, j, None] + states[:, 3 + j, None] * way + fall
    noise = np.random.default_rng([seed, 1]).standard_normal(paths.shape)
    paths += noise * [scatter.place, scatter.place, scatter.angle]
    return paths[:, :n_rows]


def bands(first_flight: ArrayLike, n_rows: int) -> Array:
    """Return the 90 % bands of a drop of the square block, predicted from its first flight.

    Parameters
    ----------
    first_flight : array_like, shape (k, 3)
        Rows of x, z [m] and theta [rad] at 250 Hz before the first impact.
    n_rows : int
        Number of rows to return, counted from the first row of `first_flight`.

    Returns
    -------
    ndarray, shape (n_rows, 3, 3)
        For each row the 5 %, 50 % and 95 % points (second axis) of x, z and unwrapped theta (last axis).

    Raises
    ------
    ArgumentError
        There are fewer than four rows of flight, a number is not finite, or no row is requested.
    """
    if not isinstance(n_rows, int | np.integer) or not 1 <= n_rows <= _MOST_ROWS:
        raise ArgumentError(f"n_rows: got {n_rows!r}, expected an integer from 1 to {_MOST_ROWS}")
    points: Array = np.quantile(ensemble(first_flight, n_rows), [0.05, 0.5, 0.95], axis=0).swapaxes(0, 1)
    return points
