"""Definition of a contact law, which all solvers can then use, and a measurement of its restitution."""

from __future__ import annotations

import math

from plow_twin import Clearance, Contact, ContactLaw, Frame, Gravity, Head, Initial, Scene, add_law, simulate

add_law(
    "logarithmic", ContactLaw("logarithmic", "D = -1.5 ln e; made up for this example", lambda e: -1.5 * math.log(e))
)


def rebound(contact: Contact) -> float:
    """Throw a head at the top wall without load. Return the ratio of its speeds after and before the impact."""
    scene = Scene(
        Head(mass_kg=500.0, inertia_kg_m2=100.0), Frame(0.3, 0.3), Clearance(0.02, 0.02), contact, Gravity(0.0),
        initial=Initial(v=(0.0, -0.5, 0.0)), locked=("x", "theta"),
    )  # fmt: skip
    # within this time, the head leaves the wall, but does not reach the opposite wall
    return abs(simulate(scene, t_end=0.035, tol=1e-10).v[-1, 1]) / 0.5


print("  nominal   own law   exact_restitution")
for e in (0.9, 0.7, 0.5, 0.3):
    own = rebound(Contact("logarithmic", stiffness=1e8, exponent=1, restitution=e))
    exact = rebound(Contact("exact_restitution", stiffness=1e8, exponent=1, restitution=e))
    print(f"{e:9.2f} {own:9.4f} {exact:12.4f}")
    assert abs(exact - e) < 1e-6
