"""Short motions of many square blocks with rounded corners that are tossed on a table.

Contacts have the normal force of `model.contact` and the spring friction of `solve.grip`. Restitution and friction
decrease with the impact speed, and vary from touch to touch by a given scatter. In flight, the drag is linear in the
velocity, and a step is as long as possible before a corner can reach the table.
"""

from __future__ import annotations

import math

import numpy as np

from plow_twin.kernel.compiler import kernel
from plow_twin.model.contact import normal_force

#: Parameters of a block, divided by its mass.
#: `half`: half the distance between the centres of its corners' arcs [m]; `radius`: radius of these arcs [m]
#: `gyration`: radius of gyration [m]; `table`: height of the table [m]
#: `stiffness`: K [1/s^2]; `tangential`: tangential stiffness relative to K [1]
#: `tangential_damping`: tangential damping relative to critical damping [1]
#: `restitution`, `friction`: coefficients at an impact speed of 1 m/s [1]
#: `restitution_fall`, `friction_fall`: exponents of their decrease with the impact speed [1]
#: `mass_power`: exponent of the effective mass in the impact speed [1]; `gravity`: acceleration by gravity [m/s^2]
#: `drag`, `spin_drag`: drag coefficients of translation and of rotation [1/s]
BLOCK = np.dtype(
    [
        (name, "f8")
        for name in (
            "half", "radius", "gyration", "table", "stiffness", "tangential", "tangential_damping", "restitution",
            "restitution_fall", "friction", "friction_fall", "mass_power", "gravity", "drag", "spin_drag",
        )
    ]
)  # fmt: skip
CORNERS = 4
#: Number of steps per half period of the stiffest contact.
_STEPS = 70.0
#: Lower limit in m/s of the impact speed in the damping of a touch, and smallest and largest restitution.
_SLOWEST, _LEAST, _LARGEST = 0.01, 0.05, 0.9
#: Impact speed in m/s below which restitution and friction are constant.
_SMALLEST_IMPACT = 0.05
#: Mobility of a corner times the mass of the block [1], for a uniform square that lands on the end of an edge. The
#: effective mass of an impact is expressed relative to this case.
_USUAL_MOBILITY = 1.5


@kernel(inline="code")
def _number(table, restitution):
    """Return the damping number D of a restitution, interpolated in a table for restitutions from 0 to 1."""
    at = restitution * (table.size - 1)
    index = min(int(at), table.size - 2)
    return table[index] + (at - index) * (table[index + 1] - table[index])


@kernel()
def _fly(block, z, h) -> None:
    """Advance a block in flight by h seconds. Its state is z = (x, z, theta, vx, vz, omega)."""
    for j in range(3):
        drag = block.spin_drag if j == 2 else block.drag
        rate = -drag * z[3 + j] - (block.gravity if j == 1 else 0.0)
        z[j] += (z[3 + j] + 0.5 * rate * h) * h
        z[3 + j] += rate * h


@kernel()
def _toss(block, numbers, scatter, dt, rows) -> None:
    z = np.empty(6)
    for j in range(6):
        z[j] = rows[0, j]
    touching, damping = np.zeros(CORNERS, np.int64), np.zeros(CORNERS)
    anchor, friction, shift = np.zeros(CORNERS), np.zeros(CORNERS), np.zeros(CORNERS)
    inertia, touches, time = block.gyration * block.gyration, 0, 0.0
    longest = math.pi / (_STEPS * math.sqrt(block.stiffness))
    spring = block.tangential * block.stiffness
    damper = 2.0 * block.tangential_damping * math.sqrt(spring)
    for row in range(1, len(rows)):
        until = row * dt
        while time < until - 1e-12:
            c, s = math.cos(z[2]), math.sin(z[2])
            gap = z[1] - block.table - block.radius - block.half * (abs(c) + abs(s))
            if gap > 1e-9:
                speed = max(-z[4], 0.0) + math.sqrt(2.0) * block.half * abs(z[5]) + 1e-3
                h = min(until - time, 0.9 * gap / speed + 1e-6)
                _fly(block, z, h)
                touching[:] = 0
                time += h
                continue
            h, along, up, moment = min(until - time, longest), 0.0, 0.0, 0.0
            for corner in range(CORNERS):
                cx = block.half if corner == 0 or corner == 3 else -block.half
                cz = block.half if corner < 2 else -block.half
                ax, az = c * cx - s * cz, s * cx + c * cz
                depth = block.table + block.radius - z[1] - az
                if depth <= 0.0:
                    touching[corner] = 0
                    continue
                # the touching point is one radius below the arc's centre
                arm = az - block.radius
                slip, rate = z[3] - z[5] * arm, -z[4] - z[5] * ax
                place = z[0] + ax + block.radius * z[2]
                if touching[corner] == 0:
                    touching[corner], anchor[corner] = 1, place
                    v0 = max(rate, _SLOWEST)
                    mass = _USUAL_MOBILITY / (1.0 + ax * ax / inertia)
                    impact = max(v0 * mass**block.mass_power, _SMALLEST_IMPACT)
                    draw = scatter[min(touches, len(scatter) - 1)]
                    touches += 1
                    e = block.restitution * impact ** (-block.restitution_fall) + draw[0]
                    damping[corner] = _number(numbers, min(max(e, _LEAST), _LARGEST)) / v0
                    shift[corner] = draw[2]
                    friction[corner] = block.friction * impact ** (-block.friction_fall) * math.exp(draw[1])
                force = normal_force(depth, rate, block.stiffness, 1.0, damping[corner], 0.0, 0.0)
                drag = spring * (place - anchor[corner]) + damper * slip
                limit = friction[corner] * force
                if abs(drag) > limit:
                    drag = limit if drag > 0.0 else -limit
                    anchor[corner] = place - (drag - damper * slip) / spring
                along -= drag
                up += force
                moment += (ax + shift[corner]) * force + arm * drag
            z[3] += h * (along - block.drag * z[3])
            z[4] += h * (up - block.gravity - block.drag * z[4])
            z[5] += h * (moment / inertia - block.spin_drag * z[5])
            for j in range(3):
                z[j] += h * z[3 + j]
            time += h
        for j in range(6):
            rows[row, j] = z[j]


@kernel(entry=True)
def toss_blocks(blocks, numbers, scatter, dt, rows) -> None:
    """Compute the motions of tossed blocks, and write one row every `dt` seconds.

    Parameters
    ----------
    blocks : ndarray of BLOCK, shape (m,)
    numbers : ndarray, shape (k,)
        Damping numbers D for evenly spaced restitutions from 0 to 1.
    scatter : ndarray, shape (m, touches, 3)
        Scatter of each touch: a term added to the restitution, a term added to the logarithm of friction, and the
        distance [m] of the normal force from the lowest point of the corner. Later touches use the last row.
    dt : float
        Time between rows in s.
    rows : ndarray, shape (m, n, 6)
        x, z, theta and their rates. The caller provides the first row of each block.
    """
    for member in range(len(blocks)):
        _toss(blocks[member], numbers, scatter[member], dt, rows[member])
