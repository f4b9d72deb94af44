"""Nominal restitution of each contact law, compared with the restitution of a free impact that our solver computes.

`python benchmark/restitution.py` writes `benchmark/results/restitution.csv`, the picture `docs/images/restitution.png`
and the generated part of `benchmark/results/restitution.md`.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cases import table

from plow_twin import Clearance, Contact, Frame, Gravity, Harmonic, Head, Initial, Scene, simulate
from plow_twin.model.contact_laws import LAWS

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / "benchmark" / "results" / "restitution.csv"
PICTURE = ROOT / "docs" / "images" / "restitution.png"
PAGE = ROOT / "benchmark" / "results" / "restitution.md"
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"

#: Nominal restitutions in the CSV file and on the page, and damping ratios C / (2 sqrt(K m)) of Kelvin-Voigt contacts.
ASKED = tuple(round(0.01 * k, 2) for k in range(101))
SHOWN = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)
RATIOS = (0.0, 0.01, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 2.0)
#: Lengths of the ramp, as multiples of the penetration v sqrt(m/K) of the undamped impact.
RAMPS = (0.001, 0.01, 0.1, 0.3, 1.0, 3.0, 10.0)
#: Largest relative difference between the computed and the nominal restitution for which a law is valid.
VALID = 0.05

MASS_KG, SPEED_M_S, STIFFNESS, EXPONENT = 2.0, 1.0, 1e9, 1.5
#: Stiffness [N/m] of the laws that add C d' to a linear spring.
LINEAR_STIFFNESS = 1e6
#: Lower limit of the impact speed [m/s]. It is so low that all restitutions below 1 use the same compiled kernels.
FLOOR = 1e-6


@dataclass(frozen=True)
class Row:
    """One free impact.

    `asked` is a restitution, or a damping ratio for laws that add C d'. `ramp` is the length of the ramp, divided by
    the penetration of the undamped impact.
    """

    law: str
    asked: float
    delivered: float
    ramp: float = 0.0


def free_impact(contact: Contact, mass: float = MASS_KG, speed: float = SPEED_M_S) -> float:
    """Return the ratio of the speeds after and before the impact of a point mass on a wall."""
    # a large inertia prevents rotation; the harmonic load selects the compiled kernels of the presets
    scene = Scene(
        head=Head(mass, 1e18),
        frame=Frame(0.2, 0.2),
        clearance=Clearance(0.01, 0.01),
        contact=contact,
        gravity=Gravity(0.0),
        loads=(Harmonic("turning nothing", (0.0, 0.0), 2.0, moment_n_m=1e3),),
        initial=Initial((0.0, 0.0, 0.0), (0.0, -speed, 0.0)),
        pairs=("top_left_top",),
    )
    # at 1 m/s, the mass reaches the wall after 5 ms; with the largest D, it rebounds within some 50 ms
    result = simulate(scene, 0.2 / speed, output_dt=0.2 / speed, tol=1e-11)
    if result.penetration[-1, 0] > 0.0 or result.statistics["top_left_top"]["makes"] != 1:
        raise RuntimeError(f"{contact}: not one whole impact")
    return float(result.v[-1, 1]) / speed


def damped(ratio: float, ramp: float, stiffness: float, mass: float, speed: float) -> Contact:
    """Return a Kelvin-Voigt contact with a damping ratio. If `ramp` > 0, the damping is ramped (see `Row`)."""
    damping = 2.0 * ratio * math.sqrt(stiffness * mass)
    if ramp == 0.0:
        return Contact("kelvin_voigt", stiffness, damping=damping)
    return Contact("ramped_damping", stiffness, damping=damping, ramp_m=ramp * speed * math.sqrt(mass / stiffness))


def measure(law: str, nominal: Iterable[float], ramp: float = 0.0) -> list[Row]:
    """Measure one law for nominal restitutions, or for damping ratios if it adds C d'. Hertz contacts have neither."""
    rows = []
    for value in nominal:
        if LAWS[law].takes_restitution:
            exponent = LAWS[law].exponent or EXPONENT
            contact = Contact(law, STIFFNESS, exponent, restitution=value, impact_speed_floor_m_s=FLOOR)
        elif LAWS[law].additive:
            contact = damped(value, ramp, LINEAR_STIFFNESS, MASS_KG, SPEED_M_S)
        else:
            contact = Contact(law, STIFFNESS, EXPONENT)
        rows.append(Row(law, value, free_impact(contact), ramp))
    return rows


def restitution_laws() -> list[str]:
    return [name for name, law in LAWS.items() if law.takes_restitution]


def valid_ranges(rows: Sequence[Row]) -> str:
    """Return the ranges of the nominal restitution (> 0) in which the law is valid."""
    inside = [row.asked > 0.0 and abs(row.delivered / row.asked - 1.0) <= VALID for row in rows]
    edges = np.flatnonzero(np.diff([False, *inside, False])).reshape(-1, 2)
    parts = [
        f"{rows[first].asked:.2f}" + (f" .. {rows[last - 1].asked:.2f}" if last - first > 1 else "")
        for first, last in edges.tolist()
    ]
    return ", ".join(parts)


def page_table(rows: Sequence[Row]) -> str:
    lines = []
    for law in restitution_laws():
        delivered = {row.asked: row.delivered for row in rows if row.law == law}
        lines.append([f"`{law}`", *(f"{delivered[e]:.4f}" for e in SHOWN)])
    return table(["law", *(f"{e:g}" for e in SHOWN)], lines)


def laws_table(rows: Sequence[Row]) -> str:
    lines = []
    for law in restitution_laws():
        own = [row for row in rows if row.law == law]
        ends = f"{own[0].delivered:.4f}", f"{own[-1].delivered:.4f}"
        lines.append([LAWS[law].title, LAWS[law].source, valid_ranges(own), *ends])
    return table(["law", "equation; source", "within 5 % for e", "at e = 0", "at e = 1"], lines)


def ratio_table(rows: Sequence[Row]) -> str:
    own = [row for row in rows if row.law == "kelvin_voigt"]
    delivered = ["restitution", *(f"{row.delivered:.4f}" for row in own)]
    return table(["C / (2 sqrt(K m))", *(f"{row.asked:g}" for row in own)], [delivered])


def ramp_table(rows: Sequence[Row]) -> str:
    ratios = [row.asked for row in rows if row.law == "kelvin_voigt"]
    lines = []
    for ramp in RAMPS:
        delivered = {row.asked: row.delivered for row in rows if row.law == "ramped_damping" and row.ramp == ramp}
        lines.append([f"{ramp:g}", *(f"{delivered[z]:.4f}" for z in ratios)])
    return table(["ramp over v sqrt(m/K)", *(f"{z:g}" for z in ratios)], lines)


def draw(rows: Sequence[Row], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (panel, share) = plt.subplots(1, 2, figsize=(12.5, 5.4), layout="constrained")
    styles = ["-", "--", "-.", (0, (5, 1)), (0, (3, 1, 1, 1)), "--", "-.", (0, (1, 1)), (0, (5, 1))]
    for index, law in enumerate(restitution_laws()):
        own = [row for row in rows if row.law == law]
        nominal, delivered = [row.asked for row in own], [row.delivered for row in own]
        exact = law == "exact_restitution"
        style = {"color": "#d62728" if exact else f"C{index if index < 3 else index + 1}", "lw": 2.6 if exact else 1.6}
        panel.plot(nominal, delivered, ls=styles[index % len(styles)], label=LAWS[law].title, **style)
        percent = [100.0 * (d / a - 1.0) for a, d in zip(nominal[1:], delivered[1:], strict=True)]
        share.plot(nominal[1:], percent, ls=styles[index % len(styles)], **style)
    panel.plot([0.0, 1.0], [0.0, 1.0], color="#888888", lw=0.8, label="delivered = asked", zorder=0)
    panel.set(xlabel="restitution asked for", ylabel="restitution delivered", xlim=(0, 1), ylim=(0, 1))
    share.axhspan(-100.0 * VALID, 100.0 * VALID, color="#dddddd", zorder=0)
    share.set(xlabel="restitution asked for", ylabel="delivered over asked, difference in % (band: 5 %)")
    share.set(xlim=(0, 1), ylim=(-40, 100))
    for axes in (panel, share):
        axes.grid(alpha=0.3)
    figure.legend(*panel.get_legend_handles_labels(), loc="outside right center", frameon=False, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def write_csv(rows: Sequence[Row], path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["law", "asked", "ramp", "delivered"])
        # nine digits are equal on all machines
        writer.writerows([row.law, f"{row.asked:g}", f"{row.ramp:g}", f"{row.delivered:.9f}"] for row in rows)


def write_page(rows: Sequence[Row], path: Path) -> None:
    """Replace the text of the page between `BEGIN` and `END`."""
    before, _, rest = path.read_text(encoding="utf-8").partition(BEGIN)
    _, _, after = rest.partition(END)
    parts = ["## Delivered", "", page_table(rows), "", "## Validity", "", laws_table(rows), ""]
    parts += ["## Kelvin-Voigt by damping ratio", "", ratio_table(rows), ""]
    parts += ["## Ramped damping by damping ratio and ramp", "", ramp_table(rows)]
    path.write_text("\n".join([before + BEGIN, "", *parts, "", END + after]), encoding="utf-8")


def main() -> None:
    rows = [row for law in restitution_laws() for row in measure(law, ASKED)]
    rows += measure("kelvin_voigt", RATIOS) + measure("hertz", (1.0,))
    rows += [row for ramp in RAMPS for row in measure("ramped_damping", RATIOS, ramp)]
    write_csv(rows, TABLE)
    draw(rows, PICTURE)
    write_page(rows, PAGE)


if __name__ == "__main__":
    main()
