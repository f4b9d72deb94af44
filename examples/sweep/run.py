"""Sweep of the largest contact force over clearance and stiffness. One call computes all members on all cores."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from plow_twin import Clearance, Status, load_scene, simulate_many

scene = load_scene("bench_kv")
clearances_mm, stiffnesses = np.linspace(20.0, 30.0, 6), np.geomspace(1e7, 1e8, 5)
members = [
    replace(
        scene,
        clearance=Clearance(horizontal_m=1e-3 * clearance, vertical_m=0.030),
        contact=replace(scene.contact, stiffness=stiffness),
    )
    for clearance in clearances_mm
    for stiffness in stiffnesses
]
ensemble = simulate_many(members, t_end=10.0, output_dt=10.0)
assert (ensemble.status == Status.OK).all()
largest = ensemble.peak.max(axis=1).reshape(len(clearances_mm), len(stiffnesses)) / 1e3

print("largest contact force [kN]")
print("clearance \\ stiffness" + "".join(f"{stiffness:10.2g}" for stiffness in stiffnesses) + " N/m")
for clearance, row in zip(clearances_mm, largest, strict=True):
    print(f"{clearance:18.1f} mm" + "".join(f"{force:10.1f}" for force in row))
