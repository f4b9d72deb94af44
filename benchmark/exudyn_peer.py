"""Exudyn on the bench scenes.

Exudyn has no connector with this contact law. Therefore each corner of the frame is a rigid-body spring-damper without
stiffness, whose force is a *symbolic* user function: it is compiled, and no Python code runs in the loop. The force
depends on the position and the velocity of the corner in the axes of the head. The loads are symbolic user functions of
time.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from bench_scenes import T_END
from cases import Array, Sample


def _force_function(sx: int, sy: int, p: Array, esym: Any) -> Callable[..., Any]:
    k, n, c = (float(number) for number in p[8:11])
    far_x, far_y = 0.5 * float(p[0] + p[2]), 0.5 * float(p[1] + p[3])
    zero = esym.Real(0.0)

    def push(depth: Any, rate: Any) -> Any:
        if n == 1.0:
            force = k * depth + c * rate
        else:
            inside = esym.max(zero, depth)
            force = k * inside * esym.sqrt(inside) * (1.0 + c * rate)
        return esym.IfThenElse(depth > 0.0, esym.max(zero, force), zero)

    def function(  # type: ignore[no-untyped-def]
        mbs, t, itemNumber, displacement, rotation, velocity, angularVelocity, stiffness, damping, rotJ0, rotJ1, offset
    ):
        x, y, om = displacement[0], displacement[1], angularVelocity[2]
        fx = sx * push(sx * x - far_x, sx * (velocity[0] - om * y))
        fy = sy * push(sy * y - far_y, sy * (velocity[1] + om * x))
        return [fx, fy, zero, zero, zero, x * fy - y * fx]

    return function


def _load_function(amplitude: float, constant: float, omega: float, esym: Any) -> Callable[..., Any]:
    def function(mbs, t, load):  # type: ignore[no-untyped-def]
        return amplitude * esym.sin(omega * t) + constant

    return function


def _build(p: Array) -> tuple[Any, Any, list[Any]]:
    sys.exudynFast = True  # type: ignore[attr-defined]  # select the build without range checks
    import exudyn as exu
    from exudyn import itemInterface as items
    from exudyn.utilities import CreateSymbolicUserFunction

    esym = exu.symbolic
    system = exu.SystemContainer()
    mbs = system.AddSystem()
    ground = mbs.AddObject(items.ObjectGround())
    node = mbs.AddNode(items.NodeRigidBody2D(referenceCoordinates=[0, 0, 0], initialVelocities=[0, 0, 0]))
    body = mbs.AddObject(items.ObjectRigidBody2D(nodeNumber=node, physicsMass=float(p[4]), physicsInertia=float(p[5])))
    centre = mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=body, localPosition=[0, 0, 0]))
    kept: list[Any] = [system]
    for sx, sy in ((-1, 1), (1, 1), (1, -1), (-1, -1)):
        place = [0.5 * sx * float(p[0]), 0.5 * sy * float(p[1]), 0.0]
        corner = mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=ground, localPosition=place))
        data = mbs.AddNode(items.NodeGenericData(initialCoordinates=[0], numberOfDataCoordinates=1))
        connector = mbs.AddObject(
            items.ObjectConnectorRigidBodySpringDamper(
                markerNumbers=[centre, corner], nodeNumber=data, stiffness=np.zeros((6, 6)), damping=np.zeros((6, 6))
            )
        )
        function = CreateSymbolicUserFunction(
            mbs, _force_function(sx, sy, p, esym), "springForceTorqueUserFunction", connector
        )
        mbs.SetObjectParameter(connector, "springForceTorqueUserFunction", function)
        kept.append(function)
    weight, omega = float(p[4] * p[6]), float(p[14])
    for coordinate, (amplitude, constant) in enumerate(((p[11], 0.0), (p[12], -weight), (p[13], -weight * p[7]))):
        marker = mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=node, coordinate=coordinate))
        load = mbs.AddLoad(items.LoadCoordinate(markerNumber=marker, load=0.0))
        of_time = _load_function(float(amplitude), float(constant), omega, esym)
        function = CreateSymbolicUserFunction(mbs, of_time, "loadUserFunction", load)
        mbs.SetLoadParameter(load, "loadUserFunction", function)
        kept.append(function)
    kept.append(node)
    return mbs, exu, kept


def prepare(p: Array, solver: str, dt: float, rtol: float | None, output_dt: float) -> Callable[[], Sample]:
    """Prepare an explicit solver with a fixed step or, if `rtol` is given, with step control.

    Each run builds a new system.
    """

    def run() -> Sample:
        mbs, exu, kept = _build(p)
        from exudyn.itemInterface import SensorNode

        sensor = mbs.AddSensor(
            SensorNode(nodeNumber=kept[-1], storeInternal=True, outputVariableType=exu.OutputVariableType.Coordinates)
        )
        mbs.Assemble()
        settings = exu.SimulationSettings()
        integration = settings.timeIntegration
        integration.numberOfSteps, integration.endTime = round(T_END / dt), T_END
        settings.solutionSettings.writeSolutionToFile = False
        settings.solutionSettings.sensorsWritePeriod = output_dt
        settings.parallel.numberOfThreads = 1
        integration.automaticStepSize = rtol is not None
        if rtol is not None:
            integration.absoluteTolerance, integration.relativeTolerance = 1e-2 * rtol, rtol
            integration.minimumStepSize = 1e-13
        integration.explicit.computeEndOfStepAccelerations = False
        begin = time.perf_counter()
        mbs.SolveDynamic(settings, solverType=getattr(exu.DynamicSolverType, solver), showHints=False)
        wall = time.perf_counter() - begin
        return Sample(wall, mbs.GetSensorStoredData(sensor)[:, 1:4], round(T_END / dt) if rtol is None else None)

    return run
