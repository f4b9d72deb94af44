"""Picture of a measured drop of a square, of the simulated drop from the same first flight, and of the 90 % band.

The example also writes a rerun file that shows the measured and the simulated body together.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import rerun as rr

from plow_twin import Initial, Scene, load_scene, simulate
from plow_twin.model.geometry import corner_radius, outline
from plow_twin.study.measured import bands
from plow_twin.study.measured.drops import Drops
from plow_twin.study.measured.square import MARKER, RATE_HZ, fit_flight

FOLDER = Path(__file__).resolve().parent
DATA = FOLDER.parent.parent / "benchmark" / "data" / "measured" / "square_drops.npz"
DROP = 4
SIDE = 0.06


def main() -> None:
    """Simulate the drop, draw it with its band, and print its distance from the measured drop."""
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples/measured_drop")
    drops = Drops.load(DATA)
    pose, given = drops.pose[DROP], int(drops.flight_rows[DROP])
    until = drops.until(DROP, 1) + 1
    bands_found = bands(pose[:given], until)
    # in the preset, the centre of the cavity is 1 m above the table
    x, z, theta, *rates = MARKER.state_of_block(fit_flight(pose[:given]).state)
    start = Initial(q=(x, z - 1.0, theta), v=(rates[0], rates[1], rates[2]))
    scene = replace(load_scene("measured_square"), initial=start)
    result = simulate(scene, t_end=(until - given) / RATE_HZ, output_dt=1.0 / RATE_HZ)
    simulated = MARKER.measured(result.q + np.array([0.0, 1.0, 0.0]))
    off = np.hypot(*(simulated[:, :2] - pose[given - 1 : until, :2]).T)
    inside = ((pose[:until] >= bands_found[:, 0]) & (pose[:until] <= bands_found[:, 2])).mean()
    print(f"first flight: {given} rows; up to the second bounce: {until} rows")
    print(f"mean distance of the simulated centre: {1e3 * off.mean():.1f} mm; measured inside the bands: {inside:.0%}")
    out.mkdir(parents=True, exist_ok=True)
    t = np.arange(until) / RATE_HZ
    figure, axes = plt.subplots(3, 1, sharex=True, figsize=(8, 7))
    for j, (axis, name) in enumerate(zip(axes, ("x [m]", "z [m]", "theta [rad]"), strict=True)):
        axis.fill_between(t, bands_found[:, 0, j], bands_found[:, 2, j], alpha=0.3, label="90 % band")
        axis.plot(t, pose[:until, j], "k.", label="measured")
        axis.plot(t[given - 1 :], simulated[:, j], label="measured_square")
        axis.set_ylabel(name)
    axes[0].legend()
    axes[2].set_xlabel("t [s]")
    figure.savefig(out / "drop.png", dpi=110)
    write_rrd(out / "drop.rrd", scene, pose[given - 1 : until], simulated)
    print(f"picture: {out / 'drop.png'}, for rerun: {out / 'drop.rrd'}")


def write_rrd(path: Path, scene: Scene, measured: np.ndarray, simulated: np.ndarray) -> None:
    """Write the motion of both bodies in mm, with y downwards, one row every 4 ms."""
    stream = rr.RecordingStream("plow_twin")
    stream.save(str(path))
    table = rr.LineStrips2D([[[-800.0, 0.0], [800.0, 0.0]]], colors=[(128, 128, 128)])
    stream.log("table", table, static=True)
    bodies = (
        ("measured", measured, outline(np.full(2, SIDE), 0.0), (213, 94, 0)),
        ("simulated", simulated, outline(np.full(2, scene.frame.width_m), corner_radius(scene)), (0, 114, 178)),
    )
    for row in range(min(len(measured), len(simulated))):
        stream.set_time("t", duration=row / RATE_HZ)
        for name, poses, body, color in bodies:
            x, z, theta = poses[row]
            turn = np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]])
            stream.log(name, rr.LineStrips2D([1e3 * (body @ turn + [x, z]) * [1.0, -1.0]], colors=[color]))
    stream.flush()


if __name__ == "__main__":
    main()
