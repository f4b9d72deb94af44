"""The vector of unknowns, its prior, and the scene of a vector.

The unknown for the stiffness K is a softness, psi = ln(u + u0). Here u = (F0 / K)^(1/n) is the penetration in m under
the reference force F0, and u0 is the penetration that a pose cannot distinguish from zero. For soft contacts psi is
linear in ln K. For hard contacts psi is linear in the compliance and has a lower limit, because the motion then only
shows that K is large.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import priors, tuning
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.priors import deviation_of, is_stated
from plow_twin.model.scene import Clearance, Contact, Scene

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Quantity:
    """One quantity that is estimated.

    Attributes
    ----------
    name : str
        Name of the quantity in an estimate.
    label, factor, digits : str, float, str
        How the quantity is printed: its name with unit, the factor to this unit, and the format.
    deviation : float
        Standard deviation of the prior about the nominal scene, in the unknown's own unit.
    dimension : tuple of 3 int
        Powers of length, mass and time in the unit of the published value; the powers of stiffness and damping follow
        from the contact law.
    step : float, optional
        Step of the difference quotient that gives the motion's derivative with respect to this quantity; None where the
        derivative is known exactly.
    fine_step : float, optional
        Step of the difference quotient of measured forces, which depend less linearly on the quantity than the motion
        does.
    probe : float
        Standard deviation of the random displacement of this quantity that tests whether the motion is predictable
        (`fit.unpredicted`).
    """

    name: str
    label: str
    factor: float
    digits: str
    deviation: float
    dimension: tuple[int, int, int] = (0, 0, 0)
    step: float | None = None
    fine_step: float | None = None
    probe: float = 0.0


#: Prior: the estimated quantities in the order of a vector of unknowns. They are the clearances in m, the softness psi
#: (published as the stiffness), the logarithm of the damping (or the logit of a restitution), three gains of the load,
#: and three biases and the delay of the sensor. The quantities with a `step` move the head and come first; the others
#: change only the measurement of the motion.
QUANTITIES: Final = (
    Quantity("horizontal", "horizontal clearance [mm]", 1e3, ".3f", 8e-3, (1, 0, 0), 2e-4, 1e-5, 5e-5),
    Quantity("vertical", "vertical clearance [mm]", 1e3, ".3f", 8e-3, (1, 0, 0), 2e-4, 1e-5, 5e-5),
    Quantity("stiffness", "stiffness [MN/m^n]", 1e-6, ".5g", 2.5, (0, 0, 0), 0.05, 2e-3, 2e-3),
    Quantity("damping", "damping", 1.0, ".5g", 1.2, (0, 0, 0), 0.05, 4e-3, 5e-3),
    Quantity("gain_fx", "load gain fx [1]", 1.0, ".4f", 0.07, (0, 0, 0), 0.01, 4e-4, 2e-3),
    Quantity("gain_fy", "load gain fy [1]", 1.0, ".4f", 0.07, (0, 0, 0), 0.01, 4e-4, 2e-3),
    Quantity("gain_m", "load gain m [1]", 1.0, ".4f", 0.07, (0, 0, 0), 0.01, 4e-4, 2e-3),
    Quantity("bias_x", "bias x [mm]", 1e3, ".3f", priors.BIAS[0], (1, 0, 0)),
    Quantity("bias_y", "bias y [mm]", 1e3, ".3f", priors.BIAS[1], (1, 0, 0)),
    Quantity("bias_theta", "bias theta [mrad]", 1e3, ".3f", priors.BIAS[2]),
    Quantity("delay", "delay [ms]", 1e3, ".3f", 0.05, (0, 0, 1)),
)


def _place(name: str) -> int:
    return next(place for place, quantity in enumerate(QUANTITIES) if quantity.name == name)


GX: Final = _place("horizontal")
GY: Final = _place("vertical")
SOFTNESS: Final = _place("stiffness")
DAMPING: Final = _place("damping")
#: Definition: slices of the gains and of the biases in a vector of unknowns.
GAIN: Final = slice(_place("gain_fx"), _place("gain_m") + 1)
BIAS: Final = slice(_place("bias_x"), _place("bias_theta") + 1)
DELAY: Final = _place("delay")
#: Definition: slice of the quantities that determine the scene (`Unknowns.scene_of`).
OF_SCENE: Final = slice(0, GAIN.start)
SIZE: Final = len(QUANTITIES)
#: Indices of the quantities that move the head.
MOVING: Final = tuple(place for place, quantity in enumerate(QUANTITIES) if quantity.step is not None)
#: Standard deviations of the random displacements that test whether the motion is predictable, shape (SIZE,).
PROBES: Final = np.array([quantity.probe for quantity in QUANTITIES])
#: Names of the quantities in the published correlation matrix; softness is the penetration under the reference force.
CORRELATED: Final = tuple("softness" if place == SOFTNESS else QUANTITIES[place].name for place in MOVING)

#: Guard: smallest and largest simulated penetration in m under the reference force. Contacts with a smaller penetration
#: give the same motion; contacts with a larger penetration let the head through the wall.
_HARDEST, _SOFTEST = 3e-5, 0.12
#: Guard: smallest clearance in m that is simulated; no motion supports a smaller estimate.
LEAST_CLEARANCE: Final = 5e-4


#: For each contact law that has an alternative: the alternative law, which an estimate tries if the contact is linear
#: (exponent 1).
OTHER_LAW: Final = {"hunt_crossley": "kelvin_voigt"}

#: Guard: smallest standard deviation of the prior; it is so small that a number stated as exact keeps its value in the
#: estimate.
_HELD = 1e-6
#: Guard: largest prior deviation of a load's gain.
_MOST_GAIN = 1.0


def _prior() -> Array:
    return np.array([quantity.deviation for quantity in QUANTITIES])


@dataclass(frozen=True, eq=False)
class Unknowns:
    """The prior about a nominal scene, and conversions between a vector of unknowns and a scene.

    Attributes
    ----------
    scene : Scene
        The nominal scene.
    deviation : ndarray, shape (SIZE,)
        Standard deviations of the prior about the nominal scene.
    noise : tuple of 3 float
        Smallest noise that the sensor can have: x, y [m], theta [rad].
    force : float
        Force F0 in N to which the softness refers.
    """

    scene: Scene
    deviation: Array = field(default_factory=_prior)
    noise: tuple[float, ...] = (0.0, 0.0, 0.0)
    force: float = 1e5

    @staticmethod
    def stated(scene: Scene, load: Load, poses: Poses) -> Unknowns:
        """Return the prior with the deviations stated for scene, load (for its gains) and poses."""
        unknowns, deviation, contact = Unknowns(scene), _prior(), scene.contact
        deviation[GX] = deviation_of(scene, "clearance.horizontal_m")
        deviation[GY] = deviation_of(scene, "clearance.vertical_m")
        deviation[SOFTNESS] = deviation_of(scene, "contact.stiffness")
        if is_stated(scene, "contact.stiffness"):
            # the standard deviation of ln K is converted to the standard deviation of psi = ln(u + u0)
            u = math.exp(unknowns.softness_of(contact.stiffness)) - tuning.RESOLVED
            deviation[SOFTNESS] *= u / (u + tuning.RESOLVED) / contact.exponent
        damped = "contact.damping" if contact.restitution is None else "contact.restitution"
        deviation[DAMPING] = deviation_of(scene, damped)
        deviation[GAIN] = np.minimum(np.hypot(deviation[GAIN], load.gain_deviations()), _MOST_GAIN)
        return Unknowns(scene, np.maximum(deviation, _HELD), poses.deviation)

    @property
    def damped(self) -> bool:
        """Whether the contact law has a damping or a restitution that can be estimated."""
        contact = self.scene.contact
        return bool(contact.damping) or (contact.restitution is not None and 0.0 < contact.restitution < 1.0)

    def nominal(self) -> Array:
        """Return the vector of the nominal scene, shape (SIZE,)."""
        contact, clearance = self.scene.contact, self.scene.clearance
        vector = np.zeros(SIZE)
        vector[[GX, GY]] = clearance.horizontal_m, clearance.vertical_m
        vector[SOFTNESS] = self.softness_of(contact.stiffness)
        if self.damped:
            e = contact.restitution
            vector[DAMPING] = math.log(e / (1.0 - e)) if e is not None else math.log(contact.damping or 1.0)
        vector[GAIN] = 1.0
        return vector

    def deviations(self) -> Array:
        """Return the prior's standard deviations (SIZE,); if the law has no damping, its entry is 1e-6."""
        deviations = self.deviation.copy()
        if not self.damped:
            deviations[DAMPING] = 1e-6
        return deviations

    def is_hard(self, vector: Array) -> bool:
        """Return whether the contact is so hard that its bounces can only be predicted for a short time."""
        return bool(vector[SOFTNESS] < math.log(tuning.CERTAINLY_HARD + tuning.RESOLVED))

    def softness_of(self, stiffness: float) -> float:
        """Return the softness psi for a stiffness."""
        return math.log((self.force / stiffness) ** (1.0 / self.scene.contact.exponent) + tuning.RESOLVED)

    def penetration_of(self, psi: float) -> float:
        """Return the penetration in m under the reference force for a softness psi."""
        return math.exp(psi) - tuning.RESOLVED

    def stiffness_of(self, psi: float) -> float:
        """Return the stiffness for a softness psi, limited to that of the hardest simulated contact."""
        u = max(math.exp(psi) - tuning.RESOLVED, _HARDEST)
        return float(self.force / u**self.scene.contact.exponent)

    def critical_damping(self, stiffness: float) -> float:
        """Return the critical damping in N s/m of the head's mass on a spring of `stiffness` N/m."""
        return 2.0 * math.sqrt(stiffness * self.scene.head.mass_kg)

    @property
    def hardest_believed(self) -> float:
        """Upper end of the published stiffness interval if the motion shows only a hard contact."""
        return float(self.force / (1e-6) ** self.scene.contact.exponent)

    def damping_of(self, value: float) -> float:
        """Return the law's restitution or damping from its unknown (logit or logarithm) `value`."""
        number = math.exp(float(np.clip(value, -30.0, 30.0)))
        return min(number / (1.0 + number), 0.999) if self._restitution else number

    def within(self, vector: Array) -> Array:
        """Return the nearest vector that can be simulated."""
        out = vector.copy()
        out[[GX, GY]] = np.maximum(out[[GX, GY]], LEAST_CLEARANCE)
        out[SOFTNESS] = np.clip(
            out[SOFTNESS], math.log(_HARDEST + tuning.RESOLVED), math.log(_SOFTEST + tuning.RESOLVED)
        )
        if self._restitution:
            out[DAMPING] = np.clip(out[DAMPING], -5.0, 5.0)
        out[GAIN] = np.clip(out[GAIN], 0.2, 5.0)
        return out

    @property
    def _restitution(self) -> bool:
        return self.scene.contact.restitution is not None

    def scene_of(self, vector: Array) -> Scene:
        """Return the scene that a vector of unknowns describes, without loads and wear."""
        damping = self.damping_of(float(vector[DAMPING])) if self.damped else None
        contact = contact_with(self.scene.contact, self.stiffness_of(float(vector[SOFTNESS])), damping)
        if self._restitution:
            contact = replace(
                contact, impact_speed_floor_m_s=max(contact.impact_speed_floor_m_s, tuning.SLOWEST_IMPACT)
            )
        clearance = Clearance(float(vector[GX]), float(vector[GY]))
        return replace(self.scene, clearance=clearance, contact=contact, loads=(), wear=None)


def contact_with(contact: Contact, stiffness: float, damping: float | None) -> Contact:
    """Return a contact with another stiffness and, unless it is None, another damping or restitution."""
    contact = replace(contact, stiffness=stiffness)
    if damping is None:
        return contact
    if contact.restitution is not None:
        return replace(contact, restitution=damping)
    return replace(contact, damping=damping)


def with_other_law(unknowns: Unknowns) -> Unknowns | None:
    """Return the prior for the alternative contact law in `OTHER_LAW`; None if there is no such law."""
    contact = unknowns.scene.contact
    law = OTHER_LAW.get(contact.law)
    if law is None or contact.exponent != 1.0:
        return None
    other = replace(contact, law=law, damping=1.0, restitution=None)
    return replace(unknowns, scene=replace(unknowns.scene, contact=other))
