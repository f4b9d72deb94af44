"""Entries that the twin accepted, in order of use, from which a second run repeats the first exactly.

Stamps are integer nanoseconds on the clock of the samples; they are never rounded through a float.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

#: A value that a parameter can take.
ParameterValue = bool | int | float | str


@dataclass(frozen=True)
class Sample:
    """Advance to `stamp_ns` with the load linear from the previous sample.

    A stamp behind the time reached belongs to a late sample, which is worked in at its place.
    `wrench` is Fx, Fy [N] and M [N m] about the cavity's centre, gravity not included.
    """

    stamp_ns: int
    wrench: tuple[float, float, float]


@dataclass(frozen=True)
class Hold:
    """Advance to `stamp_ns` with the last load held, or with the scene's own loads when these are the excitation."""

    stamp_ns: int


@dataclass(frozen=True)
class Unload:
    """Advance to `stamp_ns` with no sample and the load falling to zero on a straight line."""

    stamp_ns: int


@dataclass(frozen=True)
class Travel:
    """Travel at `speed_m_s` along the face from `stamp_ns` on; the sign is the direction."""

    stamp_ns: int
    speed_m_s: float


@dataclass(frozen=True)
class Reset:
    """Motion back to the initial state, the wear stays; the next stamp is the new origin of model time."""

    stamp_ns: int
    reason: str


@dataclass(frozen=True)
class SetWear:
    """The pads are worn by `depth_m` (8 numbers) from here on: other pads, or a measurement; the motion is reset."""

    stamp_ns: int
    depth_m: tuple[float, ...]
    reason: str


@dataclass(frozen=True)
class SetModel:
    """Numbers of the scene change from here on: `changes` is JSON, numbers by key of the scene file.

    All numbers that differ from the scene of the run; pose, rates and wear are kept. Contacts start without history.
    """

    stamp_ns: int
    changes: str


@dataclass(frozen=True)
class Restore:
    """The motion continues from the snapshot `data`; the next stamp belongs to its time. The wear stays."""

    stamp_ns: int
    data: bytes


@dataclass(frozen=True)
class Mark:
    """A mark set by the operator."""

    stamp_ns: int
    text: str


@dataclass(frozen=True)
class Failed:
    """`advances` advances have failed up to `stamp_ns`, in a row that began at `since_ns`; does not change the motion.

    There is an entry at the first failure of a row, and one for the others at its end: the sum of `advances` is their
    number.
    """

    stamp_ns: int
    since_ns: int
    advances: int
    reason: str


@dataclass(frozen=True)
class Spread:
    """Standard deviations of the load, Fx, Fy [N] and M [N m], from `stamp_ns` on; do not change the motion."""

    stamp_ns: int
    deviation: tuple[float, ...]


@dataclass(frozen=True)
class Parameter:
    """A parameter that affects the model has the new `value`."""

    name: str
    value: ParameterValue


@dataclass(frozen=True)
class Pose:
    """The head was measured at `pose` (x, y [m], theta [rad]) at `stamp_ns`: kept for the estimate, moves nothing.

    `deviation` holds the three standard deviations that came with it; empty without them.
    """

    stamp_ns: int
    pose: tuple[float, ...]
    deviation: tuple[float, ...] = ()


@dataclass(frozen=True)
class PartOfPose:
    """Only the `components` (0, 1, 2: x, y, theta) of a pose were measured: `values` [m, rad], for the estimate."""

    stamp_ns: int
    components: tuple[int, ...]
    values: tuple[float, ...]


@dataclass(frozen=True)
class Gaps:
    """Sensors have measured gaps [m] of the pairs numbered `pairs` at `stamp_ns`: kept for the estimate."""

    stamp_ns: int
    pairs: tuple[int, ...]
    gaps: tuple[float, ...]


@dataclass(frozen=True)
class Unused:
    """`count` messages of `sender` came on the input `topic` and were not used; kept as evidence, moves nothing.

    `reason` is as in the counters `dropped_<reason>`, or `not_followed`, or `lost`: never arrived (with a negative
    `count`: arrived after all). `stamps_ns` and `values` have an item for each message in order of arrival; of too many
    messages at once, they have the first. An unreadable message has no values and stamp 0. A value need not be finite.
    """

    topic: str
    sender: str
    reason: str
    count: int
    stamps_ns: tuple[int, ...]
    values: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Estimated:
    """An estimate of the window from `start_ns` to before `end_ns` is finished.

    `samples` and `poses` count the window's rows of load and pose; the fit began at `guess`, or with a search if that
    is empty. From here on `shift` (6 numbers [m]) is added to the horizontal clearance of the model with its wear, to
    its 5 % and 95 % points, then to the same for the vertical clearance. `result` is the whole estimate, JSON.
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
    """`count` entries before this one were lost; a `Snapshot` follows."""

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
    """Return x, y [m], theta [rad], NaN where it was not measured."""
    known = dict(zip(part.components, part.values, strict=True))
    return tuple(known.get(index, math.nan) for index in range(3))
