"""Tables of `docs/measured.md`, from `benchmark/results/measured.json`."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from bench_scenes import ROOT
from cases import table

RESULTS = ROOT / "benchmark" / "results" / "measured.json"
_FRICTIONS = ("regularised", "spring", "spring and damper")


def _part(name: str) -> dict[str, Any]:
    results: dict[str, Any] = json.loads(RESULTS.read_text(encoding="utf-8"))[name]
    return results


def measured_laws() -> str:
    """Return the table of RMS and median errors [m/s] of each contact law with each friction model."""
    results = _part("ellipse")

    def figures(name: str) -> str:
        return f"{results[name]['rms']:.3f} / {results[name]['median']:.3f}" if name in results else ""

    laws = [name.removesuffix(", regularised") for name in results if name.endswith(", regularised")]
    rows = [
        [f"`{law}`" if " " not in law else law, *(figures(f"{law}, {friction}") for friction in _FRICTIONS)]
        for law in laws
    ]
    single = [name for name in results if not name.endswith(_FRICTIONS)]
    return table(["RMS / median [m/s]", *_FRICTIONS], rows + [[name, figures(name), "", ""] for name in single])


def measured_drops() -> str:
    rows = []
    for name, numbers in _part("square").items():
        coverage = ["x {:.2f}, z {:.2f}, theta {:.2f}".format(*each) for each in numbers["coverage"]]
        score = "{:.1f} mm, {:.1f} mm, {:.2f} rad".format(*numbers["crps_median"])
        distance = [
            f"{mm:.1f} mm, {rad:.2f} rad" for mm, rad in zip(numbers["distance_mm"], numbers["angle_rad"], strict=True)
        ]
        rows.append([name, *distance, *coverage, score])
    others = {
        "the first, fitted to the other half of the drops": "square_held_out",
        "preset `measured_square`, by the solver": "square_preset",
    }
    for place, (name, part) in enumerate(others.items(), 1):
        numbers = _part(part)
        pairs = zip(numbers["distance_mm"], numbers["angle_rad"], strict=True)
        rows.insert(place, [name, *(f"{mm:.1f} mm, {rad:.2f} rad" for mm, rad in pairs), "", "", ""])
    counts = next(iter(_part("square").values()))["drops"]
    head = ["block", *(f"error over {n} ({count} drops)" for n, count in zip((1, 2, 3), counts, strict=True))]
    return table([*head, "inside after bounce 1", "after bounce 2", "median CRPS of x, z, theta"], rows)


def measured_rigid() -> str:
    """Return the table of errors of rigid and compliant impacts, with and without simultaneous touches."""
    results = _part("square_rigid")
    e, mu = results["e, mu"]
    names = {
        "rigid": f"rigid, one corner at a time (Routh, Poisson; e {e:.2f}, mu {mu:.2f} fitted)",
        "compliant": "compliant",
    }
    rows = [[text, *(f"{mm:.1f} mm" for mm in results[name])] for name, text in names.items()]
    return table(
        ["over one bounce", "all", f"two corners at once ({results['two_at_once']} drops)", "the others"], rows
    )


def measured_table() -> str:
    results = _part("table")
    rows = {
        "estimated": f"{results['estimated']} of {results['drops']} drops",
        "median error": f"{results['median_mm']:.2f} mm",
        "RMS error": f"{results['rms_mm']:.2f} mm",
        "half width of the 90 % interval": f"{results['half_width_mm']:.2f} mm",
        "coverage": f"{results['coverage']:.2f}",
        "share within 0.5 mm": f"{results['within_half_mm']:.2f}",
        "share within 0.5 mm or `rough`": f"{results['within_half_mm_or_rough']:.2f}",
    }
    return "\n".join(f"- {name}: {value}" for name, value in rows.items())


FIGURES: dict[str, Callable[[], str]] = {
    "measured_laws": measured_laws,
    "measured_drops": measured_drops,
    "measured_rigid": measured_rigid,
    "measured_table": measured_table,
}
