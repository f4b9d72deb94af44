"""Rows of the random scenes, compared with their references."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace

import random_scenes
from cases import Row
from work_precision import OURS_BARE, prepare_compiled

from plow_twin import Scene, SolverError
from plow_twin.solve.compiled_scene import CompiledScene, compile_scene

TOLERANCES = (1e-3, 1e-6, 1e-9)
#: Growth of a displacement at t = 0 above which no step control can keep a tolerance. Scenes above it are listed
#: separately.
AMPLIFIES = 1e4
QUICK_COUNT = 10


def random_rows(few: bool, notify: Callable[[str], None]) -> Iterator[Row]:
    """Yield a row for each random scene with its error in tolerances (`value`) and its amplification.

    With `few`, only scenes that use the same kernel as the KV bench scene are run.
    """
    saved = random_scenes.load()
    chosen = [index for index, scene in enumerate(saved.scenes) if not few or _is_plain(scene)]
    for tol in TOLERANCES:
        chaotic = saved.chaotic(tol)
        for index in chosen[: QUICK_COUNT if few else None]:
            notify(f"random scene {index}, tol={tol:g}")
            yield _row(saved, index, tol, bool(chaotic[index]), few)


def exponent_of(row: Row) -> float:
    """Return the exponent of the contact law, parsed from the name of the row's scene."""
    match = re.search(r" n=(\S+)", row.scene)
    assert match is not None
    return float(match[1])


def _is_plain(scene: Scene) -> bool:
    return scene.contact.law == "kelvin_voigt" and len(scene.loads) == 1 and not any(scene.head.com_offset_m)


def _row(saved: random_scenes.RandomScenes, index: int, tol: float, chaotic: bool, few: bool) -> Row:
    scene, output_dt, t_end = saved.scenes[index], random_scenes.OUTPUT_DT, random_scenes.T_END
    row = Row("random_scenes", _describe(index, scene), OURS_BARE, f"tol={tol:g}", output_dt, t_end)
    row.amplification = float(saved.amplification[index])
    try:
        sample = prepare_compiled(_compiled(scene, tol, few), output_dt, t_end)()
    except SolverError as problem:
        row.status = f"failed: {problem}"
        return row
    assert sample.q is not None
    row.time([sample.wall_s])
    row.steps, row.events = sample.steps, sample.events
    row.error = random_scenes.distance(scene, sample.q, saved.q[index])
    row.value = row.error / tol
    if chaotic:
        row.status = f"chaotic: references part by {saved.disagreement[index]:.1g}"
    return row


def _compiled(scene: Scene, tol: float, few: bool) -> CompiledScene:
    """Compile a scene. In a complete run, each load has a second direction, in which it may be zero.

    Thus 14 instead of 26 kernels are compiled.
    """
    compiled = compile_scene(scene, tol)
    if few:
        return compiled
    terms = compiled.parts.terms._replace(second=1)
    return replace(compiled, parts=compiled.parts._replace(terms=terms))


def _describe(index: int, scene: Scene) -> str:
    contact = scene.contact
    damping = f"e={contact.restitution:.3g}" if contact.restitution is not None else f"damping={contact.damping:.3g}"
    gx, gy = 1e3 * scene.clearance.horizontal_m, 1e3 * scene.clearance.vertical_m
    return (
        f"#{index} {contact.law} K={contact.stiffness:.3g} n={contact.exponent:g} {damping} "
        f"m={scene.head.mass_kg:.4g} kg gaps={gx:.3g}x{gy:.3g} mm"
    )
