"""Conversion of a machine to units in which it has about the size of the paper's machine.

The thresholds of the estimate were chosen for this size. The equations of motion have the same form in any units of
length, mass and time (mechanical similarity). Units that are powers of two cause no rounding errors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from plow_twin.estimate import tuning
from plow_twin.estimate.gaps import Gaps
from plow_twin.estimate.measurements import Deviation, Load, Poses
from plow_twin.estimate.priors import KINDS
from plow_twin.estimate.reason import Reason
from plow_twin.estimate.result import Estimate
from plow_twin.estimate.unknowns import QUANTITIES
from plow_twin.model import geometry
from plow_twin.model.contact_laws import LAWS
from plow_twin.model.scene import Clearance, Contact, Friction, Initial, Provenance, Scene

if TYPE_CHECKING:
    from plow_twin.estimate.contact_forces import ContactForces

#: Size of the paper's machine by definition: half of the frame's diagonal [m], mass [kg] and load period [s].
PAPER_LENGTH, _MASS, _PERIOD = 0.213, 2430.0, 3.14


@dataclass(frozen=True)
class Units:
    """Units of length [m], mass [kg] and time [s]."""

    length: float = 1.0
    mass: float = 1.0
    time: float = 1.0

    @staticmethod
    def of(scene: Scene, load: Load) -> Units:
        """Return units in which a machine has about the size of the paper's machine; SI units for similar sizes."""
        period = load.oscillation() or _PERIOD
        sizes = geometry.half_diagonal(scene) / PAPER_LENGTH, scene.head.mass_kg / _MASS, period / _PERIOD
        if scene.support is not None or all(
            1.0 / most <= size <= most for size, most in zip(sizes, tuning.ALIKE, strict=True)
        ):
            return Units()
        return Units(*(2.0 ** round(math.log2(size)) for size in sizes))

    @property
    def only_time(self) -> bool:
        """Whether only the unit of time differs from SI."""
        return self.length == self.mass == 1.0

    @property
    def force(self) -> float:
        """Unit of force in N."""
        return self.mass * self.length / self.time**2

    @property
    def speed(self) -> float:
        """Unit of speed in m/s."""
        return self.length / self.time

    def scene(self, scene: Scene) -> Scene:
        """Return a scene, without loads and wear, in these units."""
        length, mass, time = self.length, self.mass, self.time
        head, frame, clearance, gravity = scene.head, scene.frame, scene.clearance, scene.gravity
        x, y = head.com_offset_m
        (qx, qy, theta), (vx, vy, omega), speed = scene.initial.q, scene.initial.v, self.speed
        scaled = replace(
            scene,
            head=replace(
                head,
                mass_kg=head.mass_kg / mass,
                inertia_kg_m2=head.inertia_kg_m2 / (mass * length**2),
                com_offset_m=(x / length, y / length),
            ),
            frame=replace(
                frame,
                width_m=frame.width_m / length,
                height_m=frame.height_m / length,
                corner_radius_m=_over(frame.corner_radius_m, length),
            ),
            clearance=Clearance(clearance.horizontal_m / length, clearance.vertical_m / length),
            contact=self._contact(scene.contact),
            gravity=replace(
                gravity, acceleration_m_s2=gravity.acceleration_m_s2 * time**2 / length, arm_m=gravity.arm_m / length
            ),
            initial=Initial((qx / length, qy / length, theta), (vx / speed, vy / speed, omega * time)),
            friction=None if scene.friction is None else self._friction(scene.friction),
            loads=(),
            wear=None,
        )
        return replace(scaled, marks=_converted(scene, scaled))

    def load(self, load: Load) -> Load:
        """Return a load in these units."""
        fx, fy, moment = load.deviation
        force, torque = self.force, self.force * self.length
        deviation = fx / force, fy / force, moment / torque
        return Load(load.t / self.time, load.wrench / [force, force, torque], deviation)

    def poses(self, poses: Poses) -> Poses:
        """Return poses in these units."""
        length = [self.length, self.length, 1.0]
        deviation: Deviation = tuple(value / unit for value, unit in zip(poses.deviation, length, strict=True))
        return Poses(poses.t / self.time, poses.q / length, deviation)

    def gaps(self, gaps: Gaps | None) -> Gaps | None:
        """Return gaps in these units. The default error of a gap sensor in m is the same for any machine."""
        if gaps is None:
            return None
        return Gaps(gaps.t / self.time, gaps.gap / self.length, (gaps.deviation or tuning.CONSTANT_ERROR) / self.length)

    def forces(self, forces: ContactForces | None) -> ContactForces | None:
        """Return contact forces in these units."""
        if forces is None:
            return None
        return replace(forces, t=forces.t / self.time, force=forces.force / self.force)

    def in_si(self, estimate: Estimate, scene: Scene) -> Estimate:
        """Return an estimate converted from these units to SI; `scene` is the scene in SI units."""
        length, mass, time = self.length, self.mass, self.time
        contact, noise, apparent = scene.contact, estimate.noise, estimate.apparent
        unit: dict[str, float] = {
            one.name: math.prod(map(pow, (length, mass, time), one.dimension)) for one in QUANTITIES
        }
        unit["stiffness"] = self.force / length**contact.exponent
        unit["damping"] = 1.0 if contact.damping is None else self._damping(contact)
        converted: dict[str, Any] = {name: value.times(unit[name]) for name, value in estimate.values().items()}

        def unit_of(name: str) -> float:
            if name == "filter":
                return time**2
            if name == "compliance":
                return length / self.force
            return length if name.startswith(("frame.", "corner_", "turn_", "lever_")) else 1.0

        return replace(
            estimate,
            t_start=estimate.t_start * time,
            t_end=estimate.t_end * time,
            **converted,
            noise=noise and (noise[0] * length, noise[1] * length, noise[2]),
            differs={
                name: (share, by * unit_of(name), deviation * unit_of(name))
                for name, (share, by, deviation) in estimate.differs.items()
            },
            groups={name: (value.times(length), state) for name, (value, state) in estimate.groups.items()},
            forces_measured=estimate.forces_measured and estimate.forces_measured.in_units(self.force, self.time),
            reasons=tuple(
                reason.in_si(length, mass, time) if isinstance(reason, Reason) else reason
                for reason in estimate.reasons
            ),
            load_harmonics=estimate.load_harmonics and estimate.load_harmonics.in_units(self.force, length, time),
            apparent=apparent and (apparent[0].times(length), apparent[1].times(length)),
            motion=estimate.motion and estimate.motion.in_units(length, time),
        )

    def _damping(self, contact: Contact) -> float:
        """Return the unit of the damping in N s/m for an additive law, else in s/m."""
        return self.mass / self.time if LAWS[contact.law].additive else self.time / self.length

    def _contact(self, contact: Contact) -> Contact:
        return replace(
            contact,
            stiffness=contact.stiffness * self.length**contact.exponent / self.force,
            damping=_over(contact.damping, self._damping(contact)),
            impact_speed_floor_m_s=contact.impact_speed_floor_m_s / self.speed,
            restitution_speed_m_s=_over(contact.restitution_speed_m_s, self.speed),
            restitution_fall_along_s_m=_over(contact.restitution_fall_along_s_m, 1.0 / self.speed),
            ramp_m=_over(contact.ramp_m, self.length),
        )

    def _friction(self, friction: Friction) -> Friction:
        return replace(
            friction,
            regularisation_speed_m_s=friction.regularisation_speed_m_s / self.speed,
            stick_stiffness_n_m=_over(friction.stick_stiffness_n_m, self.mass / self.time**2),
            stick_damping_n_s_m=_over(friction.stick_damping_n_s_m, self.mass / self.time),
        )


def _over(value: float | None, unit: float) -> float | None:
    return None if value is None else value / unit


def _converted(scene: Scene, scaled: Scene) -> dict[str, Provenance]:
    marks, length = dict(scene.marks), scaled.frame.width_m / scene.frame.width_m
    for path, kind in KINDS.items():
        mark, (part, name) = marks.get(path), path.split(".")
        value = getattr(getattr(scene, part), name, None)
        # the ratio of the units is the converted number divided by the number, if it is not zero
        if mark is not None and mark.deviation is not None and (value or kind == "clearance"):
            ratio = length if kind == "clearance" else getattr(getattr(scaled, part), name) / value
            marks[path] = replace(mark, deviation=mark.deviation * ratio)
    return marks
