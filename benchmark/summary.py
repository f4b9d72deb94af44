"""All tables of a run, made from its rows: `benchmark/results/<machine>.md`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import targets
from cases import Row, table
from levels import LEVELS, OUTPUTS, OWN, PEERS, Reached, fastest
from random_rows import AMPLIFIES, exponent_of
from work_precision import OURS_BARE, SECTION

TITLE = "# All tables of one run of `make bench`"
_WORDS = {0.1: "output each 0.1 s", 1e-3: "output each 1 ms"}


def text(rows: Sequence[Row], machine: str, versions: dict[str, str]) -> str:
    blocks = [
        f"Machine: `{machine}`; " + ", ".join(f"{name} {version}" for name, version in versions.items()) + ".",
        _target_table(rows), *_ratio_tables(rows), _random_table(rows), _amplifying_table(rows), _ensemble_table(rows),
        *_plain_tables(rows), _not_run(rows),
    ]  # fmt: skip
    return "\n\n".join(block for block in blocks if block)


def _table(title: str, head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    body = [[cell.replace("|", "\\|") for cell in line] for line in lines]
    return f"**{title}**\n\n{table(head, body)}" if body else ""


def _target_table(rows: Sequence[Row]) -> str:
    lines = [
        (verdict.work, verdict.measured, verdict.wanted, "**reached**" if verdict.reached else "not reached")
        for verdict in targets.verdicts(rows)
    ]
    return _table("Targets", ("work", "measured", "target", ""), lines)


def _ratio_tables(rows: Sequence[Row]) -> Iterator[str]:
    for scene in ("kv", "hc"):
        for output_s in OUTPUTS:
            if any(row.section == SECTION and row.scene == scene and row.output_s == output_s for row in rows):
                lines = [list(_ratio_cells(rows, scene, output_s, level)) for level in LEVELS]
                head = ["error at most", "ours, poses only", "ours", "ours, whole call", *PEERS]
                yield _table(f"{scene.upper()}, 20 s, {_WORDS[output_s]}", head, lines)


def _ratio_cells(rows: Sequence[Row], scene: str, output_s: float, level: float) -> Iterator[str]:
    own = [fastest(rows, scene, output_s, level, member) for member in OWN.values()]
    yield f"{level:g}"
    for reached in own:
        yield "-" if reached is None else f"{reached.wall_ms:.2f} ms"
    for member in PEERS.values():
        peer = fastest(rows, scene, output_s, level, member)
        if not any(row.scene == scene and row.output_s == output_s and member(row.solver) for row in rows):
            yield "-"
        elif peer is None:
            yield "not reached"
        else:
            yield _against(peer, own[0])


def _against(peer: Reached, own: Reached | None) -> str:
    ratio = "" if own is None else f", **{peer.wall_ms / own.wall_ms:.1f}x**"
    return f"{peer.wall_ms:.4g} ms{ratio}"


def _random_table(rows: Sequence[Row]) -> str:
    picked = [row for row in rows if row.section == "random_scenes"]
    lines = []
    for tol in dict.fromkeys(row.setting for row in picked):
        at_tol = [row for row in picked if row.setting == tol]
        calm = [row for row in at_tol if row.status == "ok" and (row.amplification or 0.0) < AMPLIFIES]
        for exponent in sorted({exponent_of(row) for row in calm}):
            values = np.array([row.value for row in calm if exponent_of(row) == exponent and row.value is not None])
            worst, above = f"{values.max():.3g}", str((values > 10.0).sum())
            lines.append((tol, f"{exponent:g}", str(values.size), f"{np.median(values):.2g}", worst, above))
        listed = sum(row.status == "ok" for row in at_tol) - len(calm)
        for kind, words in (("chaotic", "no reference"), ("failed", "failed")):
            count = sum(row.status.startswith(kind) for row in at_tol)
            if count:
                lines.append((tol, words, str(count), "", "", ""))
        lines.append((tol, f"amplify {AMPLIFIES:g} times or more, below", str(listed), "", "", ""))
    return _table(
        f"Random scenes that amplify less than {AMPLIFIES:g} times: error in tolerances",
        ("tolerance", "exponent", "scenes", "median", "worst", "above 10"), lines,
    )  # fmt: skip


def _amplifying_table(rows: Sequence[Row]) -> str:
    picked = [row for row in rows if row.section == "random_scenes" and not (row.amplification or 0.0) < AMPLIFIES]
    tolerances = list(dict.fromkeys(row.setting for row in picked))
    lines = []
    for scene in dict.fromkeys(row.scene for row in picked):
        at = {row.setting: row for row in picked if row.scene == scene}
        growth = next(iter(at.values())).amplification
        cells = (
            f"{at[tol].value or 0.0:.3g}" if at[tol].status == "ok" else at[tol].status.partition(":")[0]
            for tol in tolerances
        )
        lines.append((scene, "not known" if growth is None else f"{growth:.1e}", *cells))
    head = ("scene", "amplification", *tolerances)
    return _table("Random scenes that amplify more: error in tolerances", head, lines)


def _ensemble_table(rows: Sequence[Row]) -> str:
    picked = [row for row in rows if row.section == "ensemble" and row.wall_ms is not None]
    lines = [
        (row.solver, row.setting, f"{1e-3 * (row.wall_ms or 0.0):.2f}", f"{row.error:.2g}", f"{row.value:g}")
        for row in picked
    ]
    members = [row for row in rows if row.section == "ensemble" and row.amplification is not None]
    blocks = [
        _table(
            f"Ensemble: {picked[0].scene if picked else ''}, 20 s",
            ("solver", "setting", "s", "worst error", "members beyond 1e-4"), lines,
        ),
        _table(
            "Pairs beyond 1e-4 at the tolerance used, and the ten that amplify most",
            ("pair", "setting", "error", "amplification"),
            [(row.scene, row.setting, f"{row.error:.2g}", f"{row.amplification:.2g}") for row in members],
        ),
    ]  # fmt: skip
    return "\n\n".join(block for block in blocks if block)


_TITLES = {
    "stiffness": ("Stiffness (tolerance 1e-6, error over the first 2 s against our own 1e-12)", ""),
    "machine_time": ("Machine time (tolerance 1e-6)", "steps per hour"),
    "contact_events": ("Cost against contact events (tolerance 1e-6, 20 s)", "steps per event"),
    "ensemble_hc": ("Exponent 1.5 in lanes and one by one (one core, 20 s)", "times the lanes"),
    "sampled_load": ("Sampled load (tolerance 1e-6)", "value"),
    "start": ("Start: the live twin made ready by a process with an empty cache, and by the next", "kernels compiled"),
    "features": ("What features cost (KV, tolerance 1e-6, 20 s, output each 0.1 s)", "times the plain run"),
}


def _plain_tables(rows: Sequence[Row]) -> Iterator[str]:
    for section, (title, last) in _TITLES.items():
        head = ("scene", "simulated s", "ms", "steps", "events", "error", last, "status")
        yield _table(title, head, [_plain_line(row) for row in rows if row.section == section])


def _plain_line(row: Row) -> tuple[str, ...]:
    def cell(value: float | int | None, form: str) -> str:
        return "" if value is None else format(value, form)

    return (
        row.scene, cell(row.simulated_s, "g"), cell(row.wall_ms, ".4g"), cell(row.steps, "d"), cell(row.events, "d"),
        cell(row.error, ".1e"), cell(row.value, ".4g"), row.status,
    )  # fmt: skip


def _not_run(rows: Sequence[Row]) -> str:
    peers = [row for row in rows if row.section == SECTION]
    problems = dict.fromkeys(f"- {row.solver} ({row.scene}): {row.status}" for row in peers if row.status != "ok")
    if problems:
        return "Not run or failed:\n\n" + "\n".join(problems)
    return "Every peer was run." if any(row.solver != OURS_BARE for row in peers) else ""
