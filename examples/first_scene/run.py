"""A scene of ten lines of YAML, its simulation, and a picture."""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib

from plow_twin import PAIR_NAMES, load_scene, simulate

matplotlib.use("Agg")
from matplotlib import pyplot

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples/first_scene")
out.mkdir(parents=True, exist_ok=True)

scene = load_scene(Path(__file__).parent / "scene.yaml")
result = simulate(scene, t_end=10.0, output_dt=2e-3)

for name in PAIR_NAMES:
    pair = result.statistics[name]
    print(f"{name:20}  largest {pair['max'] / 1e3:6.1f} kN, {pair['makes']:3d} makes")
print(f"{len(result.events)} changes of contact in {result.solver['steps']} steps, {1e3 * result.wall_s:.1f} ms")

figure, (motion, force) = pyplot.subplots(2, sharex=True, figsize=(9, 5), layout="constrained")
motion.plot(result.t, 1e3 * result.q[:, :2], label=["x", "y"])
motion.set_ylabel("centre of the cavity [mm]")
motion.legend(loc="upper right")
force.plot(result.t, result.force / 1e3, label=PAIR_NAMES)
force.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small")
force.set(xlabel="t [s]", ylabel="contact force [kN]")
figure.savefig(out / "motion.png", dpi=120)
print(f"picture: {out / 'motion.png'}")
