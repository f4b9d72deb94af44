"""The vector of unknowns, its prior, and the conversion of a vector to a scene.

The unknown for the stiffness K is the softness psi = ln(u + u0). Here u = (F0 / K)^(1/n) is the penetration in m under
the reference force F0, and u0 is the penetration that a pose cannot distinguish from zero. psi has a lower limit for
hard contacts, because the motion shows only that K is large.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import priors, tuning
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.priors import deviation_of, is_stated
from plow_twin.model.contact_laws import LAWS
from plow_twin.model.scene import MOST_DAMPING_FACTOR, Clearance, Contact, Scene

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Quantity:
    """Description of an estimated quantity.

    Attributes
    ----------
    name : str
        Name of the quantity in an estimate.
    label, factor, digits : str, float, str
        Printed name with unit, factor for the conversion to this unit, and number format.
    deviation : float
        Prior standard deviation in the unit of the number in the vector of unknowns.
    dimension : tuple of 3 int
        Powers of length, mass and time in the unit of the published value; unused for stiffness and damping, whose
        units depend on the contact law.
    step : float, optional
        Step of the difference quotient of the motion with respect to the quantity; None for an exact derivative.
    fine_step : float, optional
        Step of the difference quotient of contact forces, which are less linear in the quantity than the motion.
    probe : float
        Standard deviation of the random displacement that tests whether the motion is predictable (`fit.unpredicted`).
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


#: The estimated quantities with their prior deviations, in the order of a vector of unknowns. The vector contains the
#: softness psi, and the logarithm of the damping or the logit of the restitution. Quantities with a `step` change the
#: motion of the head, all other quantities only the measurement.
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
#: Definition of the gains and of the biases in a vector of unknowns.
GAIN: Final = slice(_place("gain_fx"), _place("gain_m") + 1)
BIAS: Final = slice(_place("bias_x"), _place("bias_theta") + 1)
DELAY: Final = _place("delay")
#: Definition of the slice of the quantities that determine the scene (`Unknowns.scene_of`).
OF_SCENE: Final = slice(0, GAIN.start)
SIZE: Final = len(QUANTITIES)
#: Indices of the quantities that change the motion of the head.
MOVING: Final = tuple(place for place, quantity in enumerate(QUANTITIES) if quantity.step is not None)
#: Standard deviations of the random displacements that test whether the motion is predictable, shape (SIZE,).
PROBES: Final = np.array([quantity.probe for quantity in QUANTITIES])
#: Names of the quantities in the published correlation matrix, with the softness in place of the stiffness.
CORRELATED: Final = tuple("softness" if place == SOFTNESS else QUANTITIES[place].name for place in MOVING)

#: Bounds on the simulated penetration in m under the reference force. Harder contacts give practically the same motion;
#: through softer walls, the head could pass.
_HARDEST, _SOFTEST = 3e-5, 0.12
#: Lower bound on a simulated clearance in m.
LEAST_CLEARANCE: Final = 5e-4


#: Alternative law that is tested for a contact law with the exponent 1.
OTHER_LAW: Final = {"hunt_crossley": "kelvin_voigt"}

#: Lower bound on a prior standard deviation, for numbers that are stated as exact.
_HELD = 1e-6
#: Upper bound on the prior deviation of a load gain.
_MOST_GAIN = 1.0


def _prior() -> Array:
    return np.array([quantity.deviation for quantity in QUANTITIES])


@dataclass(frozen=True, eq=False)
class Unknowns:
    """The prior of the unknowns about a nominal scene, and conversions between a vector of unknowns and a scene.

    Attributes
    ----------
    scene : Scene
        The nominal scene.
    deviation : ndarray, shape (SIZE,)
        Prior standard deviations.
    noise : tuple of 3 float
        Lower limit of the sensor's noise in x, y [m] and theta [rad].
    force : float
        Reference force F0 of the softness in N.
    nominal_scene : Scene, optional
        The scene that was given if `scene` differs from it.
    changes : dict of str to float
        Differences of `scene` from `nominal_scene`, by the paths of the numbers.
    """

    scene: Scene
    deviation: Array = field(default_factory=_prior)
    noise: tuple[float, ...] = (0.0, 0.0, 0.0)
    force: float = 1e5
    nominal_scene: Scene | None = None
    changes: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def stated(scene: Scene, load: Load, poses: Poses) -> Unknowns:
        """Return the prior with the deviations that the scene, the load and the poses state."""
        unknowns, deviation, contact = Unknowns(scene), _prior(), scene.contact
        deviation[GX] = deviation_of(scene, "clearance.horizontal_m")
        deviation[GY] = deviation_of(scene, "clearance.vertical_m")
        deviation[SOFTNESS] = deviation_of(scene, "contact.stiffness")
        if is_stated(scene, "contact.stiffness"):
            # from the standard deviation of ln K to that of psi = ln(u + u0)
            u = math.exp(unknowns.softness_of(contact.stiffness)) - tuning.RESOLVED
            deviation[SOFTNESS] *= u / (u + tuning.RESOLVED) / contact.exponent
        damped = "contact.damping" if contact.restitution is None else "contact.restitution"
        deviation[DAMPING] = deviation_of(scene, damped)
        deviation[GAIN] = np.minimum(np.hypot(deviation[GAIN], load.gain_deviations()), _MOST_GAIN)
        return Unknowns(scene, np.maximum(deviation, _HELD), poses.deviation)

    @property
    def damped(self) -> bool:
        """Whether the contact has a damping or a restitution that can be estimated."""
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
        """Return the prior standard deviations, shape (SIZE,). Without damping, its deviation is practically zero."""
        deviations = self.deviation.copy()
        if not self.damped:
            deviations[DAMPING] = 1e-6
        return deviations

    def is_hard(self, vector: Array) -> bool:
        """Return whether the contact is so hard that its bounces can be predicted only for a short time."""
        return bool(vector[SOFTNESS] < math.log(tuning.CERTAINLY_HARD + tuning.RESOLVED))

    def softness_of(self, stiffness: float) -> float:
        """Return the softness psi for a stiffness in N/m^n."""
        return math.log((self.force / stiffness) ** (1.0 / self.scene.contact.exponent) + tuning.RESOLVED)

    def penetration_of(self, psi: float) -> float:
        """Return the penetration in m under the reference force for a softness psi."""
        return math.exp(psi) - tuning.RESOLVED

    def stiffness_of(self, psi: float) -> float:
        """Return the stiffness in N/m^n for a softness psi, at most that of the hardest simulated contact."""
        u = max(math.exp(psi) - tuning.RESOLVED, _HARDEST)
        return float(self.force / u**self.scene.contact.exponent)

    def critical_damping(self, stiffness: float) -> float:
        """Return the critical damping in N s/m of the head's mass on a spring with a stiffness in N/m."""
        return 2.0 * math.sqrt(stiffness * self.scene.head.mass_kg)

    @property
    def hardest_stiffness(self) -> float:
        """Upper end in N/m^n of the interval of a stiffness that is too large to be determined."""
        return float(self.force / (1e-6) ** self.scene.contact.exponent)

    def damping_of(self, value: float) -> float:
        """Return the damping from its logarithm `value`, or the restitution from its logit `value`."""
        number = math.exp(float(np.clip(value, -30.0, 30.0)))
        return min(number / (1.0 + number), 0.999) if self._restitution else number

    def within(self, vector: Array) -> Array:
        """Return the vector with all numbers clipped to the range that can be simulated."""
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
        """Return the scene for a vector of unknowns, without loads and wear."""
        damping = self.damping_of(float(vector[DAMPING])) if self.damped else None
        contact = contact_with(self.scene.contact, self.stiffness_of(float(vector[SOFTNESS])), damping)
        if self._restitution:
            contact = replace(
                contact, impact_speed_floor_m_s=max(contact.impact_speed_floor_m_s, tuning.SLOWEST_IMPACT)
            )
        clearance = Clearance(float(vector[GX]), float(vector[GY]))
        return replace(self.scene, clearance=clearance, contact=contact, loads=(), wear=None)


def contact_with(contact: Contact, stiffness: float, damping: float | None) -> Contact:
    """Return a contact with other numbers (`contact_numbers`)."""
    numbers = contact_numbers(contact, np.array(stiffness), None if damping is None else np.array(damping))
    values: dict[str, Any] = {name: float(value) for name, value in numbers.items()}
    return replace(contact, **values)


def contact_numbers(contact: Contact, stiffness: Array, damping: Array | None) -> dict[str, Array]:
    """Return the fields of contacts with the given stiffness and, unless it is None, damping or restitution.

    A damping above the largest admissible damping factor becomes this factor.
    """
    if damping is None:
        return {"stiffness": stiffness}
    if contact.restitution is not None:
        return {"stiffness": stiffness, "restitution": damping}
    most = math.inf if LAWS[contact.law].additive else MOST_DAMPING_FACTOR
    return {"stiffness": stiffness, "damping": np.minimum(damping, most)}


def with_other_law(unknowns: Unknowns) -> Unknowns | None:
    """Return the prior for the alternative contact law in `OTHER_LAW`; None without an alternative."""
    contact = unknowns.scene.contact
    law = OTHER_LAW.get(contact.law)
    if law is None or contact.exponent != 1.0:
        return None
    other = Contact(law, contact.stiffness, damping=1.0)
    return replace(unknowns, scene=replace(unknowns.scene, contact=other))
