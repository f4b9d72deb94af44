"""Detect wrong units of measured data by the magnitude of the numbers, if a mapping states no unit."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import UnitError
from plow_twin.model.geometry import largest_angle
from plow_twin.model.loads import compile_loads
from plow_twin.model.scene import Scene
from plow_twin.record.map_file import QUANTITIES, UNITS
from plow_twin.record.mapping import Role, readings
from plow_twin.record.sources import Arrived
from plow_twin.record.times import EPOCH_S, START_NS
from plow_twin.stream.limits import excitation_limits, largest_displacement

Array = NDArray[np.float64]
_START_S: Final = START_NS * 1e-9

#: Number of messages that are checked. At 1 kHz, the checked messages cover several periods of a load.
CHECKED: Final = 20_000
#: Smallest plausible ratio of the measured forces to the largest force of the scene. An idling machine exceeds this
#: ratio.
_IDLE_SHARE: Final = 1e-2
#: Smallest ratio at which forces are taken for numbers in kN. Smaller forces may be the noise of an idle sensor.
_BROKEN_SHARE: Final = 1e-4
#: Likely units of too small forces, with the factor for `_IDLE_SHARE` and `_BROKEN_SHARE`.
_SMALLER: Final = {"kN": 1.0, "MN": 1e-3}
#: Largest angle of the model [rad], 45 degrees.
_LARGEST_ANGLE_RAD: Final = 0.25 * np.pi
#: Largest plausible swing (half the range of an angle), as a multiple of the angle that the clearance allows. Wear and
#: compressed contacts do not let a head turn farther, so the angle must be in degrees.
_BEYOND_CLEARANCE: Final = 3.0
#: Swing that is always accepted [rad]. With soft pads, a head turns farther than a narrow clearance allows.
_BELIEVED_SWING_RAD: Final = 0.1
#: Largest plausible distance of stamps [s] if the load changes smoothly from sample to sample.
_SLOW_S: Final = 0.5
#: Largest median change between two samples of a smooth load, as a share of the range of the load.
_SMOOTH: Final = 0.05
#: Largest plausible speed of a plough [m/s]. The fastest ploughs travel at 3.6 m/s (Caterpillar GH1600).
_FASTEST_M_S: Final = 5.0
#: Shares of descending stamps above which the column is not a time, and above which the rows are in reverse order.
_FALLING, _REVERSED = 0.2, 0.9
_TIMES: Final = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
#: Range of the dates of this century in a spreadsheet, which counts days from 1900.
_SHEET_DAYS: Final = (36_525.0, 73_050.0)
#: Smallest number of samples for a check of the stamps.
_FEW: Final = 20
_SORT: Final = "sort the rows by time"
_NAME_TIME: Final = "name the column of the time in a mapping (stamp: NAME)"
_WRITE_SECONDS: Final = "write seconds, or dates such as 2026-01-02T03:04:05.678Z"
#: Smallest plausible distance of stamps [s], because load cells measure at 10 kHz at most.
_SHORTEST_SPACING_S: Final = 1e-4


@dataclass(frozen=True)
class UnitDoubt:
    """Doubt that the numbers of a role are in SI units.

    The name `t` in `names` means the stamps of the load. `found` and `expected` are magnitudes in SI units, and
    `likely` is the unit that the numbers seem to have. If `is_impossible`, no head can move as the numbers state.
    `advice` replaces the advice to state the unit.
    """

    role: str
    names: tuple[str, ...]
    found: str
    expected: str
    likely: str
    is_impossible: bool = False
    advice: str = ""

    def __str__(self) -> str:
        return f"{', '.join(self.names)}: got {self.found}, expected {self.expected}; they look like {self.likely}"

    @property
    def remedy(self) -> str:
        """Advice to the user. The default advice explains how to state the unit."""
        return self.advice or "state the unit: " + " ".join(
            f"--unit {name}={self.likely.replace(' ', '')}" for name in self.names
        )


def unit_doubts(
    values: Mapping[tuple[str, str], Sequence[float] | Array], load_stamps_s: Sequence[float] | Array, scene: Scene
) -> list[UnitDoubt]:
    """Return the doubts about the units of measured numbers, whose magnitudes are compared with the scene.

    `values` contains the measured numbers of each quantity, by role and name, such as ("excitation", "fx"). A missing
    number is NaN.
    """
    magnitudes = {key: _usual_magnitude(np.asarray(number, float)) for key, number in values.items()}
    load = [values["excitation", name] for name in ("fx", "fy", "m") if ("excitation", name) in values]
    spacing = _spacing(np.asarray(load_stamps_s, float), np.array(load, float).T) if load else []
    angle = _angle(np.asarray(values.get(("head_pose", "theta"), ()), float), scene)
    return [*_load(magnitudes, scene), *_lengths(magnitudes, scene), *angle, *_travel(values), *spacing]


def small_thresholds(thresholds: Sequence[float], scene: Scene) -> str:
    """Return a warning if the thresholds of the contact force [N] seem to be in kN, otherwise an empty string."""
    usual = _largest_force(scene)
    small = [threshold for threshold in thresholds if 0.0 < threshold < _IDLE_SHARE * usual]
    if not small:
        return ""
    return f"alarm_force: got {small[0]:g} N, expected about {usual:.2g} N as in the scene; is it in kN?"


def large_loads(values: Mapping[tuple[str, str], Array], units: Mapping[str, str], scene: Scene) -> dict[str, str]:
    """Return a warning for each component of the load that a live twin would refuse, by name of the component.

    A live twin refuses numbers above the limits that `excitation_limits` returns for the scene. The warning is given if
    more than one number in a hundred exceeds the limit. `values` contains measured numbers by role and name [SI units],
    and `units` the original unit of each component.
    """
    messages = {}
    for name, most in zip(("fx", "fy", "m"), excitation_limits(scene).largest, strict=True):
        key = "excitation", name
        largest = _usual_magnitude(values.get(key, np.zeros(0)))
        if not 0.0 < most < largest:
            continue
        factors = UNITS[QUANTITIES[key]]
        si = next(iter(factors))
        raw = largest / factors[units.get(name, si)]
        likely = next((unit for unit, factor in reversed(factors.items()) if raw * factor <= most), "")
        remedy = f"state the unit: --unit {name}={likely.replace(' ', '')}" if likely else "is it this machine's scene?"
        expected = f"at most {most:.2g} {si}, ten times the scene's"
        messages[name] = f"{name}: got {largest:.3g} {si}, expected {expected}: {remedy}"
    return messages


def check_units(messages: Iterable[Arrived], roles: Mapping[str, Role], scene: Scene, source: object) -> None:
    """Check the units in the first 20,000 messages of a recording.

    A quantity is not checked if the mapping states its unit, scale or limits. Raise `UnitError` if the numbers of a
    quantity seem to be in another unit. The error contains advice on how to state the unit.
    """
    stamps: list[float] = []
    values: dict[tuple[str, str], list[float]] = {}
    for role, _, reading in readings(islice(messages, CHECKED), roles):
        if reading is not None:
            if role == "excitation":
                stamps.append(reading[0] * 1e-9)
            for name, value in reading[1].items():
                values.setdefault((role, name), []).append(value)
    doubts = unstated(unit_doubts(values, stamps, scene), roles)
    if doubts:
        raise UnitError(f"{source}: " + "; ".join(f"{doubt}: {doubt.remedy}" for doubt in doubts))


def unstated(doubts: Iterable[UnitDoubt], roles: Mapping[str, Role]) -> list[UnitDoubt]:
    """Return the doubts about quantities for which `roles` state no unit, scale or limits, and doubts with `advice`."""
    return [doubt for doubt in doubts if doubt.advice or not _stated(doubt, roles)]


def check_poses(t: Array, q: Array, scene: Scene, source: object) -> None:
    """Check the units of measured poses.

    The poses `q`, shape (n, 3), are x, y [m] and theta [rad] at the times `t` [s], shape (n,). An error names the
    recording by `source`. Raise `UnitError` if the numbers of a quantity seem to be in another unit.
    """
    magnitudes = {("head_pose", name): _usual_magnitude(q[:, place]) for place, name in enumerate(("x", "y"))}
    doubts = [*_lengths(magnitudes, scene), *_angle(q[:, 2], scene), *_spacing(t, q)]
    if doubts:
        remedy = doubts[0].advice or "convert the file to SI"
        raise UnitError(f"{source}: {'; '.join(map(str, doubts))}: {remedy}")


def _stated(doubt: UnitDoubt, roles: Mapping[str, Role]) -> bool:
    role = roles.get(doubt.role)
    if role is None:
        return False
    if doubt.names == ("t",):
        return role.stamp_unit_is_stated
    return set(doubt.names) <= {*role.factor, *role.scale, *role.limits}


def _usual_magnitude(values: Array, percent: float = 99.0) -> float:
    """Return a percentile of the magnitudes; unlike the maximum, it does not depend on outliers."""
    magnitudes = np.abs(values)[np.isfinite(values)]
    return float(np.percentile(magnitudes, percent)) if magnitudes.size else 0.0


def _load(magnitudes: Mapping[tuple[str, str], float], scene: Scene) -> list[UnitDoubt]:
    """Return doubts about the forces and the moment.

    Only the larger of the two forces is checked, because the smaller force may be small in any unit.
    """
    loads = [magnitudes[key] for key in (("excitation", "fx"), ("excitation", "fy")) if key in magnitudes]
    usual = _largest_force(scene)
    largest = max(loads, default=0.0)
    doubts = []
    for unit, size in _SMALLER.items():
        if _BROKEN_SHARE * size * usual < largest < _IDLE_SHARE * size * usual:
            expected = f"about {usual:.2g} N as in the scene"
            doubts = [UnitDoubt("excitation", ("fx", "fy"), f"{largest:.3g}", expected, unit)]
            largest *= UNITS["force"][unit]
    if largest < _IDLE_SHARE * usual:
        return doubts
    # if the forces are smaller than in the scene, a smaller moment is expected
    beside = float(compile_loads(scene.loads).largest()[2]) * min(1.0, largest / usual) if usual else 0.0
    moment = magnitudes.get(("excitation", "m"), 0.0)
    if _BROKEN_SHARE * beside < moment < _IDLE_SHARE * beside:
        expected = f"about {beside:.2g} N m with such forces, as in the scene"
        doubts.append(UnitDoubt("excitation", ("m",), f"{moment:.3g}", expected, "kN m"))
    return doubts


def _angle(theta: Array, scene: Scene) -> list[UnitDoubt]:
    """Return a doubt if an angle exceeds the range of the model, or if the swing is too large for the clearance."""
    largest = _usual_magnitude(theta)
    if scene.head.carries == "corners" or not 0.0 < largest < np.degrees(_LARGEST_ANGLE_RAD):
        return []
    # the swing does not depend on the zero of the sensor, which may differ from the zero of the head
    low, high = np.percentile(theta[np.isfinite(theta)], (0.5, 99.5))
    swing = 0.5 * float(high - low)
    allowed = max(_BELIEVED_SWING_RAD, _BEYOND_CLEARANCE * largest_angle(scene))
    if largest > _LARGEST_ANGLE_RAD:
        description, expected = f"{largest:.3g}", f"less than {_LARGEST_ANGLE_RAD:.3g} rad"
    elif swing > allowed:
        description, expected = f"a swing of {swing:.3g} to either side", f"at most {allowed:.2g} rad in this clearance"
    else:
        return []
    return [UnitDoubt("head_pose", ("theta",), description, expected, "deg", True)]


def _lengths(magnitudes: Mapping[tuple[str, str], float], scene: Scene) -> list[UnitDoubt]:
    doubts = []
    most = largest_displacement(scene)
    for (role, name), largest in magnitudes.items():
        if (role == "gaps" or (role == "head_pose" and name != "theta")) and most < largest < 1e3 * most:
            expected = f"less than half the frame or the clearance, {most:.3g} m"
            doubts.append(UnitDoubt(role, (name,), f"{largest:.3g}", expected, "mm", True))
    return doubts


def _travel(values: Mapping[tuple[str, str], Sequence[float] | Array]) -> list[UnitDoubt]:
    speed = _usual_magnitude(np.asarray(values.get(("travel", "speed"), ()), float), 90.0)
    if speed <= _FASTEST_M_S:
        return []
    likely = "km/h" if speed <= 3.6 * _FASTEST_M_S else "m/min"
    return [UnitDoubt("travel", ("speed",), f"{speed:.3g}", f"at most {_FASTEST_M_S:g} m/s, as ploughs reach", likely)]


def _largest_force(scene: Scene) -> float:
    amplitude = compile_loads(scene.loads).largest()
    return max(float(amplitude[:2].max()), scene.head.mass_kg * abs(scene.gravity.acceleration_m_s2))


def _spacing(stamps_s: Array, load: Array) -> list[UnitDoubt]:
    """Return a doubt if stamps descend, or if consecutive stamps of a smooth load are too far apart."""
    if len(stamps_s) < _FEW:
        return []
    steps = np.diff(stamps_s)
    falling = float((steps < 0.0).mean())
    if falling > _FALLING:
        description, expected = f"stamps of which {falling:.0%} fall", "times that rise"
        if falling > _REVERSED:
            likely, advice = "rows from the newest to the oldest", _SORT
        else:
            likely, advice = "another column", _NAME_TIME
        return [UnitDoubt("excitation", ("t",), description, expected, likely, advice=advice)]
    if stamps_s.max() > EPOCH_S:
        return []
    spacing = float(np.median(np.abs(steps)))
    # the function `time_ns` has added a second to times that count from an unknown start
    low, high = (days + _START_S for days in _SHEET_DAYS)
    if low <= stamps_s[0] <= high and np.ptp(stamps_s) < 1.0 and spacing < _SHORTEST_SPACING_S:
        description = f"{stamps_s[0] - _START_S:.6g} and stamps {spacing:.2g} s apart"
        return [UnitDoubt("excitation", ("t",), description, "seconds", "days of a spreadsheet", advice=_WRITE_SECONDS)]
    load = load[np.isfinite(load).all(axis=1)]
    span = np.ptp(load, axis=0) if len(load) >= _FEW else np.zeros(0)
    if spacing < _SLOW_S or not span.any():
        return []
    change = np.median(np.abs(np.diff(load[:, span > 0.0], axis=0)), axis=0) / span[span > 0.0]
    if not float(change.max()) < _SMOOTH:
        return []
    description = f"stamps {spacing:.4g} s apart"
    likely = next((unit for unit, size in _TIMES.items() if spacing * size < _SLOW_S), "ns")
    return [UnitDoubt("excitation", ("t",), description, "many samples in each period of such a smooth load", likely)]
