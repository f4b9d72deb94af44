"""Entries that the twin accepted, in order of use; from them a second run repeats the first run exactly.

Stamps are integer nanoseconds on the clock of the samples; they are never rounded through a float.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

ParameterValue = bool | int | float | str


@dataclass(frozen=True)
class Sample:
    """Advance to `stamp_ns`; the load varies linearly from the previous sample to this sample.

    `wrench` is Fx, Fy [N] and M [N m] about the cavity's centre, without gravity. A stamp that the model has passed
    belongs to a late sample, which is inserted at its place in time.
    """

    stamp_ns: int
    wrench: tuple[float, float, float]


@dataclass(frozen=True)
class Hold:
    """Advance to `stamp_ns` with the last load held, or under the scene's own loads if they are the excitation."""

    stamp_ns: int


@dataclass(frozen=True)
class Unload:
    """Advance to `stamp_ns` without a sample; the load falls linearly to zero."""

    stamp_ns: int


@dataclass(frozen=True)
class Travel:
    """Travel at `speed_m_s` along the face from `stamp_ns` on; the sign is the direction."""

    stamp_ns: int
    speed_m_s: float


@dataclass(frozen=True)
class Reset:
    """The motion returns to the initial state and the wear stays; the next stamp is the new origin of model time."""

    stamp_ns: int
    reason: str


@dataclass(frozen=True)
class SetWear:
    """The wear depths become `depth_m` (8 numbers), after new pads or a measurement; the motion is reset."""

    stamp_ns: int
    depth_m: tuple[float, ...]
    reason: str


@dataclass(frozen=True)
class SetModel:
    """Numbers of the scene change: `changes` is a JSON object of numbers by their keys in the scene file.

    `changes` has all numbers that differ from the scene of the run. Pose, rates and wear are kept; contacts start
    without history.
    """

    stamp_ns: int
    changes: str


@dataclass(frozen=True)
class Restore:
    """The motion continues from the snapshot `data`, and the wear stays; the next stamp is at the snapshot's time."""

    stamp_ns: int
    data: bytes


@dataclass(frozen=True)
class Mark:
    """A mark set by the operator."""

    stamp_ns: int
    text: str


@dataclass(frozen=True)
class Failed:
    """`advances` advances up to `stamp_ns` have failed, in a stretch that began at `since_ns`; no effect on the motion.

    A stretch of failures has one entry at its first failure, and another at its end for all further failures.
    """

    stamp_ns: int
    since_ns: int
    advances: int
    reason: str


@dataclass(frozen=True)
class Spread:
    """Standard deviations of the load, Fx, Fy [N] and M [N m], from `stamp_ns` on; no effect on the motion."""

    stamp_ns: int
    deviation: tuple[float, ...]


@dataclass(frozen=True)
class Parameter:
    """A parameter that affects the model has the new `value`."""

    name: str
    value: ParameterValue


@dataclass(frozen=True)
class Pose:
    """The head was measured at `pose` (x, y [m], theta [rad]) at `stamp_ns`; kept for the estimate.

    `deviation` has the three standard deviations that came with the pose, or is empty.
    """

    stamp_ns: int
    pose: tuple[float, ...]
    deviation: tuple[float, ...] = ()


@dataclass(frozen=True)
class PartOfPose:
    """Only `components` (0, 1, 2: x, y, theta) of a pose were measured: `values` [m, rad], kept for the estimate."""

    stamp_ns: int
    components: tuple[int, ...]
    values: tuple[float, ...]


@dataclass(frozen=True)
class Gaps:
    """Sensors have measured the `gaps` [m] of the pairs numbered `pairs` at `stamp_ns`; kept for the estimate."""

    stamp_ns: int
    pairs: tuple[int, ...]
    gaps: tuple[float, ...]


@dataclass(frozen=True)
class Unused:
    """`count` messages of `sender` arrived on the input `topic` and were not used; no effect on the motion.

    `reason` is the name in a counter `dropped_<reason>`, or `not_followed`, or `lost` for messages that never arrived
    (a negative `count` means that they arrived after all). `stamps_ns` and `values` have an item for each message, or
    only for the first of very many messages. An unreadable message has no values and stamp 0. Values need not be
    finite.
    """

    topic: str
    sender: str
    reason: str
    count: int
    stamps_ns: tuple[int, ...]
    values: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Estimated:
    """The estimate from the window that begins at `start_ns` and ends just before `end_ns` is finished.

    `samples` and `poses` count the load samples and poses in the window; the fit began at `guess`, or with a search if
    `guess` is empty. From this entry on, the 6 numbers of `shift` [m] are added to the model's horizontal clearance
    (with wear) and its 5 % and 95 % quantiles, and to the same three numbers of the vertical clearance. `result` is the
    whole estimate (JSON).
    """

    start_ns: int
    end_ns: int
    samples: int
    poses: int
    guess: tuple[float, ...]
    shift: tuple[float, ...]
    result: str


@dataclass(frozen=True)
class Snapshot:
    """The exact state of the session at `stamp_ns`, from which a run can be resumed."""

    stamp_ns: int
    data: bytes


@dataclass(frozen=True)
class Digest:
    """Hash of the exact state at `stamp_ns`."""

    stamp_ns: int
    digest: str


@dataclass(frozen=True)
class Loss:
    """`count` entries before this entry were lost; a `Snapshot` follows."""

    count: int


Entry = (
    Sample
    | Hold
    | Unload
    | Travel
    | Reset
    | SetWear
    | SetModel
    | Restore
    | Mark
    | Failed
    | Spread
    | Parameter
    | Pose
    | PartOfPose
    | Gaps
    | Unused
    | Estimated
    | Snapshot
    | Digest
    | Loss
)


def whole_pose(part: PartOfPose) -> tuple[float, ...]:
    """Return x, y [m] and theta [rad], NaN for a component that was not measured."""
    known = dict(zip(part.components, part.values, strict=True))
    return tuple(known.get(index, math.nan) for index in range(3))
