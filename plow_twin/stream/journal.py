"""Entries of the journal, which records the inputs of a twin in order of use.

A replay of the entries repeats the run exactly. Stamps are integer nanoseconds on the clock of the samples. They are
never converted to floats, which would round them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

ParameterValue = bool | int | float | str


@dataclass(frozen=True)
class Sample:
    """Advance to `stamp_ns`; the load varies linearly from the previous sample to this sample.

    `wrench` is Fx, Fy [N] and M [N m] about the cavity's centre, without gravity. A sample older than the time reached
    by the model is inserted at its place in time.
    """

    stamp_ns: int
    wrench: tuple[float, float, float]


@dataclass(frozen=True)
class Hold:
    """Advance to `stamp_ns` with the load held at its last value.

    If the loads of the scene are the excitation, the loads of the scene act.
    """

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
    """Return to the initial state without a change of the wear; the next stamp is the new origin of model time."""

    stamp_ns: int
    reason: str


@dataclass(frozen=True)
class SetWear:
    """Set the wear depths [m] of the 8 pads, after a measurement or after pads were replaced, and reset the motion."""

    stamp_ns: int
    depth_m: tuple[float, ...]
    reason: str


@dataclass(frozen=True)
class SetModel:
    """Change numbers of the scene. Pose, rates and wear do not change. Contacts start without history.

    `changes` is a JSON object with all numbers that differ from the scene of the run, by their keys in the scene file.
    """

    stamp_ns: int
    changes: str


@dataclass(frozen=True)
class Restore:
    """Continue from the motion in the snapshot `data`, with the present wear, at the next stamp."""

    stamp_ns: int
    data: bytes


@dataclass(frozen=True)
class Mark:
    """A remark that the operator has attached to a time."""

    stamp_ns: int
    text: str


@dataclass(frozen=True)
class Failed:
    """Report that `advances` advances up to `stamp_ns` failed; the entry has no effect on the motion.

    Consecutive failures form a stretch, which began at `since_ns`. The first failure of a stretch has an entry of its
    own. A second entry at the end of the stretch counts the second and all later failures.
    """

    stamp_ns: int
    since_ns: int
    advances: int
    reason: str


@dataclass(frozen=True)
class Spread:
    """Standard deviations of the load (Fx, Fy [N], M [N m]) from `stamp_ns` on, without effect on the motion."""

    stamp_ns: int
    deviation: tuple[float, ...]


@dataclass(frozen=True)
class Parameter:
    """New value of a parameter that affects the model."""

    name: str
    value: ParameterValue


@dataclass(frozen=True)
class Pose:
    """Measured pose of the head (x, y [m], theta [rad]), an input of the estimate.

    `deviation` contains the standard deviations [m, m, rad] that the sender has stated, or is empty.
    """

    stamp_ns: int
    pose: tuple[float, ...]
    deviation: tuple[float, ...] = ()


@dataclass(frozen=True)
class PartOfPose:
    """Measured pose with missing components, an input of the estimate.

    `components` contains the indices of the measured components (0: x, 1: y, 2: theta), and `values` their values [m,
    rad].
    """

    stamp_ns: int
    components: tuple[int, ...]
    values: tuple[float, ...]


@dataclass(frozen=True)
class Gaps:
    """Measured gaps [m] of the pairs with the indices `pairs`, an input of the estimate."""

    stamp_ns: int
    pairs: tuple[int, ...]
    gaps: tuple[float, ...]


@dataclass(frozen=True)
class Unused:
    """Messages of `sender` on the input `topic` that were not used; the entry has no effect on the motion.

    `reason` is `not_followed`, `lost` (for messages that never arrived), or the name of a reason in a counter
    `dropped_<reason>`. A negative `count` withdraws a loss, because the messages arrived after all. `stamps_ns` and
    `values` have an item for each message, or only for the first of very many messages. An unreadable message has the
    stamp 0 and no values. Values need not be finite.
    """

    topic: str
    sender: str
    reason: str
    count: int
    stamps_ns: tuple[int, ...]
    values: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Estimated:
    """A finished estimate, from the measurements of a window."""

    #: beginning and end of the window; the end is not part of the window
    start_ns: int
    end_ns: int
    #: numbers of load samples and of poses in the window
    samples: int
    poses: int
    #: starting point of the fit; it is empty if the fit began with a search
    guess: tuple[float, ...]
    #: shifts [m] that are added to the model's clearances from the time of this entry on, length 6; the first three
    #: shifts are for the horizontal clearance with wear, its 5 % quantile and its 95 % quantile; the last three shifts
    #: are for the vertical clearance
    shift: tuple[float, ...]
    #: the whole estimate (JSON)
    result: str


@dataclass(frozen=True)
class Snapshot:
    """Exact state of the session at `stamp_ns`, from which a run can be resumed."""

    stamp_ns: int
    data: bytes


@dataclass(frozen=True)
class Digest:
    """Hash of the exact state at `stamp_ns`."""

    stamp_ns: int
    digest: str


@dataclass(frozen=True)
class Loss:
    """Loss of `count` entries before this entry; a `Snapshot` follows."""

    count: int


Entry = (
    Sample | Hold | Unload | Travel | Reset | SetWear | SetModel | Restore | Mark | Failed | Spread | Parameter | Pose
    | PartOfPose | Gaps | Unused | Estimated | Snapshot | Digest | Loss
)  # fmt: skip


def pose_entry(stamp_ns: int, pose: tuple[float, ...], deviation: tuple[float, ...] = ()) -> Pose | PartOfPose:
    """Return the entry of a measured pose (x, y [m], theta [rad]), in which a missing component is NaN."""
    measured = tuple(index for index, value in enumerate(pose) if math.isfinite(value))
    if len(measured) < len(pose):
        return PartOfPose(stamp_ns, measured, tuple(pose[index] for index in measured))
    return Pose(stamp_ns, pose, deviation)


def whole_pose(entry: Pose | PartOfPose) -> tuple[float, ...]:
    """Return x, y [m] and theta [rad] of a pose, with NaN for each component that was not measured."""
    if isinstance(entry, Pose):
        return entry.pose
    values = dict(zip(entry.components, entry.values, strict=True))
    return tuple(values.get(index, math.nan) for index in range(3))
