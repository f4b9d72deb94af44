"""Prior standard deviations of the numbers of a scene, either stated in the scene or by default."""

from __future__ import annotations

import math
from typing import Final

from plow_twin.model.scene import Mark, Scene

#: Prior standard deviations of numbers without a stated deviation, by kind and by mark (the source of a number).
#:
#: - clearance, stiffness, damping: a drawing does not show wear, and contact parameters are seldom known without a
#:   measurement
#: - mass, inertia: a drawing gives the values to some percent
#: - frame: a drawing gives the sides up to a tolerance, and it does not show the rounding of the corners
#: - exponent, friction: the contact law is idealised, and friction is seldom documented
#: - creep (the speed below which friction is viscous): a number of the model that no machine has
#:
#: The deviations of clearance and frame are in m, the deviations of mass, inertia and creep are relative. For stiffness
#: and damping they apply to the logarithm, for a restitution to the logit.
DEFAULTS: Final[dict[str, dict[Mark, float]]] = {
    "clearance": {Mark.GIVEN: 8e-3, Mark.MEASURED: 2e-3, Mark.RECONSTRUCTED: 8e-3, Mark.ASSUMED: 8e-3},
    "stiffness": {Mark.GIVEN: 2.5, Mark.MEASURED: 0.5, Mark.RECONSTRUCTED: 2.5, Mark.ASSUMED: 2.5},
    "damping": {Mark.GIVEN: 1.2, Mark.MEASURED: 0.5, Mark.RECONSTRUCTED: 1.2, Mark.ASSUMED: 1.2},
    "mass": {Mark.GIVEN: 0.02, Mark.MEASURED: 0.01, Mark.RECONSTRUCTED: 0.05, Mark.ASSUMED: 0.10},
    "inertia": {Mark.GIVEN: 0.05, Mark.MEASURED: 0.02, Mark.RECONSTRUCTED: 0.10, Mark.ASSUMED: 0.20},
    "frame": {Mark.GIVEN: 1e-3, Mark.MEASURED: 5e-4, Mark.RECONSTRUCTED: 2e-3, Mark.ASSUMED: 5e-3},
    "exponent": {Mark.GIVEN: 0.07, Mark.MEASURED: 0.03, Mark.RECONSTRUCTED: 0.07, Mark.ASSUMED: 0.07},
    "friction": {Mark.GIVEN: 0.05, Mark.MEASURED: 0.02, Mark.RECONSTRUCTED: 0.05, Mark.ASSUMED: 0.05},
    "creep": {Mark.GIVEN: 0.5, Mark.MEASURED: 0.2, Mark.RECONSTRUCTED: 0.5, Mark.ASSUMED: 0.5},
}
#: Scale in m of the half-normal prior of the corner radius if the scene states no radius.
ROUNDING: Final = 3e-3
#: Prior standard deviations of a sensor's scale factors of x, y and theta.
SCALES: Final = (5e-3, 5e-3, 1e-2)
#: Prior standard deviations of a sensor's bias of x, y [m] and theta [rad].
BIAS: Final = (5e-3, 5e-3, 0.02)
#: Prior standard deviations of quantities that a scene cannot state:
#:
#: - `stiffness_<wall>`, `damping_<wall>`: stiffness and damping of a wall relative to those of the contact
#: - `turn_<wall>`: rotation of a wall, as the difference in m between the outward displacements of its two pads
#: - `scale_<axis>`: scale factor of the sensor
#: - `lever_<axis>`: lever arm of the sensor in m
#: - `filter`: squared time constant of the sensor's low pass in s2, without its mean delay
#: - `clock`: relative drift of the sensor's clock
#: - `load_<component>`: constant error of the load in units of half its range
#: - `compliance`: displacement of the frame per force in m/N; a force of 100 kN moves the frame by 0.25 mm
UNSTATED: Final = {
    **{f"stiffness_{wall}": 0.1 for wall in ("left", "right", "top", "bottom")},
    **{f"damping_{wall}": 0.3 for wall in ("left", "right", "top", "bottom")},
    **{f"turn_{wall}": 1e-3 for wall in ("left", "right", "top", "bottom")},
    **{f"scale_{axis}": scale for axis, scale in zip(("x", "y", "theta"), SCALES, strict=True)},
    **{f"lever_{axis}": 4e-3 for axis in ("x", "y")},
    **{f"load_{name}": 0.02 for name in ("fx", "fy", "m")},
    "filter": 4e-4,
    "clock": 1e-4,
    "compliance": 2.5e-9,
}
#: Key in `DEFAULTS` of each number of a scene, by the path of the number.
KINDS: Final = {
    "clearance.horizontal_m": "clearance",
    "clearance.vertical_m": "clearance",
    "contact.stiffness": "stiffness",
    "contact.damping": "damping",
    "contact.restitution": "damping",
    "head.mass_kg": "mass",
    "head.inertia_kg_m2": "inertia",
    "frame.width_m": "frame",
    "frame.height_m": "frame",
    "contact.exponent": "exponent",
    "friction.coefficient": "friction",
    "friction.regularisation_speed_m_s": "creep",
}


def is_stated(scene: Scene, path: str) -> bool:
    """Return whether the scene states the standard deviation of the number at a path."""
    provenance = scene.marks.get(path)
    return provenance is not None and provenance.deviation is not None


def deviation_of(scene: Scene, path: str) -> float:
    """Return the prior standard deviation of the number at a path, in the units of `DEFAULTS`.

    A number without a mark is treated as assumed.
    """
    kind, provenance = KINDS[path], scene.marks.get(path)
    if provenance is None or provenance.deviation is None:
        return DEFAULTS[kind][Mark.ASSUMED if provenance is None else provenance.mark]
    part, name = path.split(".")
    owner = getattr(scene, part)
    value = float(getattr(owner, name)) if owner is not None else 0.0
    if name == "restitution":
        return provenance.deviation / max(value * (1.0 - value), 1e-6)
    if kind in ("stiffness", "damping", "mass", "inertia", "creep"):
        share = provenance.deviation / max(abs(value), 1e-300)
        # a log-normal number with the relative deviation s has a logarithm with the variance ln(1 + s^2)
        return math.sqrt(2.0 * math.log(math.hypot(1.0, share))) if kind in ("stiffness", "damping") else share
    return provenance.deviation
