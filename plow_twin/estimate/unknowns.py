"""What is estimated: the vector of unknowns, its prior, and the scene that a vector stands for.

Softness stands for the stiffness: u = (F0 / K)^(1/n) is the penetration in m under the reference force F0, and the
unknown is psi = ln(u + u0). For soft contacts it acts as ln K, for hard ones as the compliance: there the motion tells
no more than that K is large, and psi has an end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate.measurements import Load, Poses
from plow_twin.model.scene import Clearance, Contact, Scene

Array = NDArray[np.float64]

GX: Final = 0
GY: Final = 1
SOFTNESS: Final = 2
DAMPING: Final = 3
GAIN: Final = slice(4, 7)
BIAS: Final = slice(7, 10)
DELAY: Final = 10
SIZE: Final = 11
NAMES: Final = (
    "horizontal", "vertical", "softness", "damping", "gain_fx", "gain_fy", "gain_m",
    "bias_x", "bias_y", "bias_theta", "delay",
)  # fmt: skip
#: Unknowns that change the motion; the others only change how it is measured.
MOVING: Final = tuple(range(7))

#: Impact speed in m/s below which lambda = D / v0 is not followed: touches at rest would make the contact stiff and the
#: fit slow, for what a sensor of the pose does not see.
SLOWEST_IMPACT: Final = 0.03

#: u0 in m: penetrations below it cannot be told from none.
_RESOLVED = 1e-4
#: Smallest softness in m that is simulated; harder contacts move the head alike.
_HARDEST = 3e-5
#: Softness in m below which a contact is hard.
_HARD = 3e-4
#: Largest softness in m.
_SOFTEST = 0.12
#: Smallest clearance in m that is simulated.
_LEAST_CLEARANCE = 5e-4


#: The law that a linear contact may have instead of the one believed.
OTHER_LAW: Final = {"hunt_crossley": "kelvin_voigt"}

#: Largest prior deviation of a load's gain.
_MOST_GAIN = 1.0


@dataclass(frozen=True)
class Spread:
    """Standard deviations of the prior about the nominal scene."""

    clearance_m: float = 8e-3
    #: of ln(u + u0) and of ln of the damping (of the logit of a restitution)
    softness: float = 2.5
    damping: float = 1.2
    gain: tuple[float, float, float] = (0.07, 0.07, 0.07)
    bias_m: float = 5e-3
    bias_rad: float = 0.02
    delay_s: float = 0.05
    #: least noise of the sensor that is believed: x, y [m], theta [rad]
    noise: tuple[float, ...] = (0.0, 0.0, 0.0)

    @staticmethod
    def stated(load: Load, poses: Poses) -> Spread:
        """Return the prior where deviations are stated; that of a load is taken to move all its samples alike."""
        fx, fy, moment = np.minimum(np.hypot(Spread().gain, load.gain_deviations()), _MOST_GAIN).tolist()
        return Spread(gain=(fx, fy, moment), noise=poses.deviation)


@dataclass(frozen=True)
class Unknowns:
    """The prior about a nominal scene, and what a vector of unknowns means."""

    scene: Scene
    spread: Spread = field(default_factory=Spread)
    #: force F0 in N to which the softness refers
    force: float = 1e5

    @property
    def damped(self) -> bool:
        """Whether the law has a damping that can be estimated."""
        contact = self.scene.contact
        return bool(contact.damping) or (contact.restitution is not None and 0.0 < contact.restitution < 1.0)

    def nominal(self) -> Array:
        """Return the vector of the nominal scene, shape (11,)."""
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
        """Return the prior's standard deviations, shape (11,)."""
        s = self.spread
        return np.array(
            [
                s.clearance_m, s.clearance_m, s.softness, s.damping if self.damped else 1e-6, *s.gain,
                s.bias_m, s.bias_m, s.bias_rad, s.delay_s,
            ]
        )  # fmt: skip

    def steps(self) -> Array:
        """Return the steps of difference quotients, shape (11,)."""
        return np.array([2e-4, 2e-4, 0.05, 0.05, 0.01, 0.01, 0.01, 1.0, 1.0, 1.0, 1.0])

    def is_hard(self, vector: Array) -> bool:
        """Tell whether the contact is so hard that its bounces cannot be foretold for long."""
        return bool(vector[SOFTNESS] < math.log(_HARD + _RESOLVED))

    def softness_of(self, stiffness: float) -> float:
        """Return psi of a stiffness."""
        return math.log((self.force / stiffness) ** (1.0 / self.scene.contact.exponent) + _RESOLVED)

    def penetration_of(self, psi: float) -> float:
        """Return the penetration in m under the reference force."""
        return math.exp(psi) - _RESOLVED

    def stiffness_of(self, psi: float) -> float:
        """Return the stiffness of psi, at most that of the hardest contact that is simulated."""
        u = max(math.exp(psi) - _RESOLVED, _HARDEST)
        return float(self.force / u**self.scene.contact.exponent)

    def critical_damping(self, stiffness: float) -> float:
        """Return the damping in N s/m with which the head's mass on a spring of `stiffness` N/m just does not swing."""
        return 2.0 * math.sqrt(stiffness * self.scene.head.mass_kg)

    @property
    def hardest_believed(self) -> float:
        """Stiffness up to which the prior reaches where the motion only tells that the contact is hard."""
        return float(self.force / (1e-6) ** self.scene.contact.exponent)

    def damping_of(self, value: float) -> float:
        """Return the number that the law takes, its restitution or its damping."""
        number = math.exp(float(np.clip(value, -30.0, 30.0)))
        return min(number / (1.0 + number), 0.999) if self._restitution else number

    def within(self, vector: Array) -> Array:
        """Return the nearest vector that can be simulated."""
        out = vector.copy()
        out[[GX, GY]] = np.maximum(out[[GX, GY]], _LEAST_CLEARANCE)
        out[SOFTNESS] = np.clip(out[SOFTNESS], math.log(_HARDEST + _RESOLVED), math.log(_SOFTEST + _RESOLVED))
        if self._restitution:
            out[DAMPING] = np.clip(out[DAMPING], -5.0, 5.0)
        out[GAIN] = np.clip(out[GAIN], 0.2, 5.0)
        return out

    @property
    def _restitution(self) -> bool:
        return self.scene.contact.restitution is not None

    def scene_of(self, vector: Array) -> Scene:
        """Return the scene that a vector stands for."""
        damping = self.damping_of(float(vector[DAMPING])) if self.damped else None
        contact = contact_with(self.scene.contact, self.stiffness_of(float(vector[SOFTNESS])), damping)
        if self._restitution:
            contact = replace(contact, impact_speed_floor_m_s=max(contact.impact_speed_floor_m_s, SLOWEST_IMPACT))
        clearance = Clearance(float(vector[GX]), float(vector[GY]))
        return replace(self.scene, clearance=clearance, contact=contact, loads=(), wear=None)


def contact_with(contact: Contact, stiffness: float, damping: float | None) -> Contact:
    """Return a contact with a stiffness and the number that its law takes for damping (None: its own)."""
    contact = replace(contact, stiffness=stiffness)
    if damping is None:
        return contact
    if contact.restitution is not None:
        return replace(contact, restitution=damping)
    return replace(contact, damping=damping)


def with_other_law(unknowns: Unknowns) -> Unknowns | None:
    """Return the prior about a scene with the law that its contact may have instead, None where no such is known."""
    contact = unknowns.scene.contact
    law = OTHER_LAW.get(contact.law)
    if law is None or contact.exponent != 1.0:
        return None
    other = replace(contact, law=law, damping=1.0, restitution=None)
    return replace(unknowns, scene=replace(unknowns.scene, contact=other))
