"""Calibration of the stiffness and damping of a contact to a measured motion."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from plow_twin import dump_scene, load_scene, simulate

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples/calibration")
out.mkdir(parents=True, exist_ok=True)

# a simulated motion replaces the measurement; its contact is stiffer than the assumed contact
believed = load_scene("bench_kv")
true = replace(believed, contact=replace(believed.contact, stiffness=3.1e7, damping=8.5e4))
motion = simulate(true, t_end=2.0, output_dt=0.01)
table = np.column_stack([motion.t, motion.q])
np.savetxt(out / "measured.csv", table, fmt="%.17g", delimiter=",", header="t,x,y,theta", comments="")
(out / "believed.yaml").write_text(dump_scene(believed))

command = [
    *(sys.executable, "-m", "plow_twin", "study", "calibrate", out / "believed.yaml"),
    *("--recording", out / "measured.csv", "--out", out / "fit", "--seed", "1", "--starts", "1"),
    *("--unknown", "contact.stiffness=5e6:1e8:log", "--unknown", "contact.damping=1e4:3e5:log"),
    *("--screen", "40", "--population", "12", "--generations", "12"),
]
subprocess.run([str(word) for word in command], check=True)

found = load_scene(out / "fit" / "fit.yaml").contact
print(f"stiffness {found.stiffness:.6g} N/m, true 3.1e7; damping {found.damping:.6g} N s/m, true 8.5e4")
assert found.damping is not None
assert abs(found.stiffness / 3.1e7 - 1.0) < 1e-4 and abs(found.damping / 8.5e4 - 1.0) < 1e-4
