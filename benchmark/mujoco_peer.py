"""MuJoCo on the Kelvin-Voigt bench scene.

Each corner of the frame is a fixed sphere of radius r. The walls of the cavity are boxes on the head, displaced
outwards by r. A negative `solref` sets the stiffness and damping of a constraint. MuJoCo scales them by the inverse
weight A of the bodies and the impedance d. With a small d and solref = -(K, C) A (1 - d), the force is K d + C d'. A is
multiplied by 1e6, so that the regularisation of the constraint outweighs the coupling of the contacts. Contacts never
pull, as in F = max(0, K d + C d'). A law with d^1.5 is not possible.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from bench_scenes import T_END
from cases import Array, Sample

_RADIUS, _THICKNESS, _IMPEDANCE, _WEIGHT = 0.05, 0.05, 1e-4, 1e6


def _model(p: Array, integrator: str, dt: float) -> Any:
    import mujoco

    half_x, half_y = 0.5 * p[0], 0.5 * p[1]
    far_x, far_y = 0.5 * (p[0] + p[2]) + _RADIUS, 0.5 * (p[1] + p[3]) + _RADIUS
    corners = ((-half_x, half_y), (half_x, half_y), (half_x, -half_y), (-half_x, -half_y))
    spheres = "".join(
        f'<geom type="sphere" size="{_RADIUS}" pos="{x!r} {y!r} 0" contype="1" conaffinity="2" condim="1" priority="1" '
        f'solref="-1 -1" solimp="{_IMPEDANCE} {_IMPEDANCE} 0.001 0.5 1"/>'
        for x, y in ((float(x), float(y)) for x, y in corners)
    )
    walls = "".join(
        f'<geom type="box" size="{sx!r} {sy!r} 0.05" pos="{x!r} {y!r} 0" contype="2" conaffinity="1" condim="1"/>'
        for sx, sy, x, y in (
            (0.5, _THICKNESS, 0.0, float(far_y + _THICKNESS)), (0.5, _THICKNESS, 0.0, -float(far_y + _THICKNESS)),
            (_THICKNESS, 0.5, float(far_x + _THICKNESS), 0.0), (_THICKNESS, 0.5, -float(far_x + _THICKNESS), 0.0),
        )
    )  # fmt: skip
    inertia = " ".join([repr(float(p[5]))] * 3)
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler autolimits="true"/><option timestep="{dt!r}" gravity="0 {-float(p[6])!r} 0" '
        f'integrator="{integrator}" cone="elliptic" solver="Newton" iterations="100" tolerance="1e-12">'
        '<flag eulerdamp="disable"/></option>'
        f'<worldbody>{spheres}<body name="head"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>'
        f'<joint type="hinge" axis="0 0 1"/><inertial pos="0 0 0" mass="{float(p[4])!r}" diaginertia="{inertia}"/>'
        f"{walls}</body></worldbody></mujoco>"
    )
    head = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "head")
    model.body_invweight0[head] *= _WEIGHT
    scale = model.body_invweight0[head, 0] * (1.0 - _IMPEDANCE)
    model.geom_solref[:] = [-p[8] * scale, -p[10] * scale]
    return model


def prepare(p: Array, integrator: str, dt: float, output_dt: float) -> Callable[[], Sample]:
    """Prepare a run with `mujoco.rollout`, whose loop is compiled. Loads are sampled at the middle of each step."""
    import mujoco
    from mujoco import rollout

    model = _model(p, integrator, dt)
    data = mujoco.MjData(model)
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    steps, stride = round(T_END / dt), round(output_dt / dt)
    applied = np.zeros((1, steps, model.nv))
    load = np.sin(p[14] * (np.arange(steps) + 0.5) * dt)
    applied[0] = load[:, None] * p[11:14] - np.array([0.0, 0.0, p[4] * p[6] * p[7]])
    start = np.zeros((1, mujoco.mj_stateSize(model, full)))
    mujoco.mj_getState(model, mujoco.MjData(model), start[0], full)
    # the states of all steps need much memory, so the run is divided into pieces
    piece = max(stride, 20_000 // stride * stride)

    def run() -> Sample:
        wall, state, rows = 0.0, start.copy(), [np.zeros((1, 3))]
        for first in range(0, steps, piece):
            control = applied[:, first : first + piece]
            begin = time.perf_counter()
            states, _ = rollout.rollout(
                model, data, state, control, control_spec=int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
            )
            wall += time.perf_counter() - begin
            state = states[:, -1].copy()
            rows.append(states[0, stride - 1 :: stride, 1:4])
        return Sample(wall, np.concatenate(rows), steps)

    return run
