"""Errors of the following twin for machines whose terms differ from the paper's: laws, friction, wear, locks, walls.

    python benchmark/follow_machines.py --truths 1 --seed 74000
    python benchmark/follow_machines.py --table              # table of the truths in the file

The scene of each machine states these terms. Clearances, stiffness, damping or restitution and load gains are unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import follow
from estimate_truths import Group

from plow_twin import Contact, Friction, Gravity, Harmonic, Scene, Wear
from plow_twin.model.contact_laws import LAWS, ContactLaw, add_law

RESULTS = Path(__file__).resolve().parent / "results" / "follow_machines.jsonl"
SOFT, HARD = (3e6, 3e8), (1e9, 1e11)
#: Number of load periods. Some of the stored results are from ten load periods.
_PERIODS = 7.0
Change = Callable[[Scene], Scene]


def _restitution(law: str) -> Change:
    return lambda scene: replace(scene, contact=Contact(law, scene.contact.stiffness, restitution=0.5))


def _own_law(scene: Scene) -> Scene:
    if "own" not in LAWS:
        add_law("own", ContactLaw("own law", "D = 2 (1 - e)", lambda e: 2.0 * (1.0 - e)))
    return _restitution("own")(scene)


def _damped(contact: Contact) -> Change:
    return lambda scene: replace(scene, contact=contact)


def _sticking(stiffness: float) -> Change:
    return lambda scene: replace(scene, friction=Friction(0.1, stick_stiffness_n_m=stiffness))


def _worn(scene: Scene) -> Scene:
    """Return a scene whose clearances grow by some 0.5 mm in ten load periods."""
    return replace(scene, wear=Wear(2.5e-12, 0.015, 2.0))


def _one_wall(scene: Scene) -> Scene:
    """Return a scene of a head that rests on two corners and is lifted by its load."""
    lift = Harmonic("lift", (0.0, 2.7e4), 20.0, at_m=(-0.01, 0.0))
    pairs = tuple(name for name in scene.pairs if name.endswith("_top"))
    return replace(scene, pairs=pairs, locked=("x", "theta"), loads=(lift,), gravity=Gravity(9.81, 0.0))


def _locked(*names: str) -> Change:
    return lambda scene: replace(scene, locked=names)


def _corners(scene: Scene) -> Scene:
    return replace(scene, head=replace(scene.head, carries="corners"))


def _unchanged(scene: Scene) -> Scene:
    return scene


def _weightless(scene: Scene) -> Scene:
    return replace(scene, gravity=Gravity(0.0))


_KELVIN_VOIGT = Contact("kelvin_voigt", 9.7e6, damping=8e4)
_HARD_KELVIN_VOIGT = Contact("kelvin_voigt", 1e10, damping=1.5e6)
_RAMPED = Contact("ramped_damping", 9.7e6, damping=8e4, ramp_m=1e-3)
_PARTS: tuple[tuple[str, str, Change | None, Change | None], ...] = (
    ("restitution", "exact restitution", *2 * (_restitution("exact_restitution"),)),
    ("table", "law of Flores et al.", *2 * (_restitution("flores"),)),
    ("own", "own law", _own_law, None),
    ("kelvin_voigt", "Kelvin-Voigt", _damped(_KELVIN_VOIGT), _damped(_HARD_KELVIN_VOIGT)),
    ("ramped", "ramped damping", _damped(_RAMPED), None),
    ("stick", "friction 0.1 with stick", _sticking(5e6), _sticking(5e8)),
    ("worn", "wear", *2 * (_worn,)),
    ("one_wall", "one wall, x and theta locked", *2 * (_one_wall,)),
    ("lock_theta", "theta locked", *2 * (_locked("theta"),)),
    ("lock_x", "x locked", *2 * (_locked("x"),)),
    ("corners", "head with corners", *2 * (_corners,)),
    ("weightless", "no gravity", *2 * (_weightless,)),
    ("cutting", "cutting load, sampled at 500 Hz", *2 * (_unchanged,)),
)
_LAW = {"kelvin_voigt": "kelvin_voigt", "ramped": "ramped_damping"}
_HARDNESS = {"soft": SOFT, "hard": HARD}
GROUPS = {
    f"{name}_{hardness}": Group(
        f"{title}, {hardness}", stiffness=_HARDNESS[hardness], machine=change, law=_LAW.get(name, "hunt_crossley"),
        periods=_PERIODS, load_step=2e-3 if name in ("one_wall", "cutting") else 1e-2, stochastic=name == "cutting",
    )
    for name, title, *changes in _PARTS
    for hardness, change in zip(_HARDNESS, changes, strict=True)
    if change is not None
}  # fmt: skip


def as_markdown(rows: Sequence[dict[str, Any]]) -> str:
    """Return a table with a row for each machine, whose cells contain the value with soft, then with hard contacts.

    Most coverages of the clearances are 1, so a line below the table lists the others.
    """
    drawn = {row["group"]: row for row in rows if "not_drawn" not in row}

    def cell(name: str, form: Callable[[dict[str, Any]], str]) -> str:
        return "; ".join(form(drawn[f"{name}_{kind}"]) for kind in _HARDNESS if f"{name}_{kind}" in drawn)

    lines = [
        "| machine | forces, RMS [%]: nominal, followed | largest force [%] | impulse [%] | coverage of these three | "
        "share of a core |",
        "|---|---|---|---|---|---|",
    ]
    for name, title, *_ in _PARTS:
        if not {f"{name}_{kind}" for kind in _HARDNESS} & set(drawn):
            continue
        cells = (
            lambda row: f"{100 * row['rms_nominal']:.0f}, {100 * row['rms']:.1f}",
            lambda row: f"{100 * row['peak']:.1f}",
            lambda row: f"{100 * row['impulse']:.1f}",
            lambda row: f"{row['coverage_late']:.2f}, {row['peak_coverage']:.2f}, {row['impulse_coverage']:.2f}",
            lambda row: f"{row['cores']:.2f}",
        )
        lines.append(f"| {title} | " + " | ".join(cell(name, form) for form in cells) + " |")
    lower = [
        f"{title}, {kind} contacts: {coverage:.2f}"
        for name, title, *_ in _PARTS
        for kind in _HARDNESS
        if (row := drawn.get(f"{name}_{kind}"))
        and (coverage := 0.5 * (row["horizontal_coverage"] + row["vertical_coverage"])) < 0.995
    ]
    exceptions = f" ({'; '.join(lower)})" if lower else ""
    return "\n".join([*lines, "", f"Coverage of the clearances: 1.00{exceptions}."])


main = follow.command(GROUPS, RESULTS, 1, 74000, as_markdown)


if __name__ == "__main__":
    main()
