"""Tables of the pages, from the files in `benchmark/results`. `tools/pages.py` writes them to the pages."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Sequence
from typing import Any

import estimate_pages
import follow
import follow_machines
import lives
import measured_pages
import month
import targets
import tuning_sensitivity
from bench_scenes import ROOT
from cases import Row, read_rows, table
from ensemble_rows import core_row
from estimate import load_rows
from levels import OWN, PEERS, fastest
from work_precision import OURS_BARE, OURS_CALL

RESULTS = ROOT / "benchmark" / "results"
#: File with the name of the machine of the newest complete run, which the pages quote.
NEWEST = RESULTS / "newest.txt"
#: Processors by the beginning of a machine's name, which contains vendor, brand, family and model.
_PROCESSORS = {
    "amd_epyc_f26m": "an AMD EPYC (Zen 5)",
    "intel_r_xeon_r_processor_f6m167": "an Intel Xeon (family 6, model 167)",
    "intel_r_xeon_r_processor_f6m207": "an Intel Xeon with AVX-512",
}
_PEERS = (
    "CVODE from C", "CVODE from C, rootfinding", "heyoka", "best of SciPy and scikit-sundae", "lean jitted RK4",
)  # fmt: skip


def solver_rows() -> list[Row]:
    """Return the rows of the newest complete run of `make bench`."""
    return read_rows(RESULTS / f"{_machine_name()}.csv")


def _machine_name() -> str:
    """Return the name of the machine of the newest complete run."""
    return NEWEST.read_text(encoding="utf-8").strip()


def _processor() -> str:
    name = _machine_name()
    return next((text for prefix, text in _PROCESSORS.items() if name.startswith(prefix)), f"the machine `{name}`")


def machine() -> str:
    """Return a sentence with the processor of the newest complete run, and the file with its tables."""
    return (
        f"The figures before it were measured on {_processor()}. "
        f"`benchmark/results/{_machine_name()}.md` contains all tables."
    )


def speed() -> str:
    """Return a table of run times for 20 s of impacts at three errors, and the processor.

    Times of peers are multiples of our times.
    """
    rows = solver_rows()
    lines = []
    for level in (1e-3, 1e-6, 1e-9):
        own = _own_ms(rows, "kv", 0.1, level, OURS_BARE)
        peers = [_times(rows, "kv", 0.1, level, peer, own) for peer in _PEERS]
        lines.append([f"{level:g}", f"{own:.2f} ms", *peers])
    return f"{table(['error / clearance [1]', 'plow_twin', *_PEERS], lines)}\n\nMeasured on {_processor()}."


def located() -> str:
    """Return a table of run times with output every 0.1 s, with the two peers that locate each change of contact."""
    rows = solver_rows()
    lines = []
    for scene in ("kv", "hc"):
        for level in (1e-6, 1e-9):
            where = scene, 0.1, level
            own = _own_ms(rows, *where, OURS_BARE)
            peers = [_times(rows, *where, peer, own) for peer in ("heyoka", "compiled DOP853, events located")]
            whole = _times(rows, *where, "heyoka", _own_ms(rows, *where, OURS_CALL))
            lines.append([scene.upper(), f"{level:g}", f"{own:.2f} ms", *peers, whole])
    head = ["scene", "error", "plow_twin", "heyoka", "DOP853", "heyoka / whole call of `simulate`"]
    return table(head, lines)


def work() -> str:
    rows = solver_rows()
    (row_of_load,) = [row for row in rows if row.section == "sampled_load" and "256" not in row.scene]
    many = [row for row in rows if row.section == "sampled_load" and "256" in row.scene]
    pairs = core_row(rows)
    hours = {row.scene: row for row in rows if row.section == "machine_time" and row.simulated_s == 3600.0}
    starts = [row.wall_ms for row in rows if row.section == "start"]
    assert pairs is not None and pairs.wall_ms is not None and None not in starts
    lines = [
        ["one live twin with load samples at 1 kHz", f"{row_of_load.value:.0f} times as fast as real time"],
        *([_many_twins(row.scene), f"{row.value:.2f} of a core"] for row in many),
        [
            "20 s of motion for 1,000 pairs of clearances, each pose within 1e-4 of the clearance",
            f"{1e-3 * pairs.wall_ms:.2f} s",
        ],
        ["an hour of the bench scene", f"{1e-3 * (hours['kv'].wall_ms or 0.0):.1f} s"],
        *([f"an hour {name}", f"{row.wall_ms:.2g} ms"] for name, row in hours.items() if "rest" in name),
        ["first start of a live twin, with compiling", f"{1e-3 * (starts[0] or 0.0):.0f} s"],
        ["later starts", f"{starts[1] or 0.0:.0f} ms"],
    ]
    return "\n".join(f"- {name}: {value}" for name, value in lines)


def missed() -> str:
    groups: dict[tuple[str, str], list[targets.Verdict]] = {}
    for verdict in targets.verdicts(solver_rows()):
        if not verdict.reached:
            peer = verdict.work.partition(", against ")[2]
            groups.setdefault((f"against {peer}" if peer else verdict.work, verdict.wanted), []).append(verdict)
    lines = []
    for (work, target), rows in groups.items():
        shown = sorted(map(_short, rows), key=lambda text: float(text.rstrip("x")) if text.endswith("x") else 0.0)
        lines.append([work, str(len(rows)), " to ".join(dict.fromkeys((shown[0], shown[-1]))), target])
    return table(["target not reached", "cases", "measured", "wanted"], lines)


def random_scenes() -> str:
    rows = [verdict for verdict in targets.verdicts(solver_rows()) if "random scenes" in verdict.work]
    tolerances = [re.search(r"tol=([\d.e-]+)", row.work) for row in rows]
    texts = [row.measured.replace("worst", "largest").replace(" 0 failed", " no scene failed") for row in rows]
    return "\n".join(f"- tolerance {tol[1]}: {text}" for tol, text in zip(tolerances, texts, strict=True) if tol)


def stored(name: str) -> Callable[[], str]:
    def shown() -> str:
        with (RESULTS / f"{name}.csv").open(newline="", encoding="utf-8") as file:
            head, *lines = csv.reader(file)
        return table(head, lines)

    return shown


def measured_sum() -> str:
    _, *rows = estimate_pages.narrowed(measured_pages.measured_drops(), (0, 1, 2, 4))
    return table(["block", "error over one bounce", "over two", "inside the 90 % band after one"], rows)


def replay() -> str:
    with (RESULTS / "replay.csv").open(newline="", encoding="utf-8") as file:
        _, *rows = csv.reader(file)
    unit = ", times real time"
    return "\n".join(f"- {name.removesuffix(unit)}: {value}{unit[1:] * name.endswith(unit)}" for name, value, _ in rows)


def life_table() -> str:
    return lives.summary(load_rows(RESULTS / "lives.jsonl"))


def life_sum() -> str:
    rows = load_rows(RESULTS / "lives.jsonl")
    parts = [[row for row in rows if row["share"] == share] for share in lives.SHARES]

    def held(own: list[dict[str, Any]], inner: int) -> str:
        return f"{100 * sum(row[f'inside_{inner}'] for row in own) / len(own):.0f} %"

    right = sum(abs(row["error"]) <= lives.ALPHA for row in rows)
    shares = ", ".join(f"{share:g}" for share in lives.SHARES)
    return (
        f"At {shares} of the life, {right} of {len(rows)} forecasts of its end are within {100 * lives.ALPHA:.0f} %.\n"
        f"The 80 % interval contains this end in {', '.join(held(own, 80) for own in parts)} of the lives, "
        f"the 90 % interval in {', '.join(held(own, 90) for own in parts)}."
    )


def month_table() -> str:
    rows = load_rows(RESULTS / "month.jsonl")
    days = list(dict.fromkeys(row["day_m"] for row in rows))
    tables = [month.summary([row for row in rows if row["day_m"] == day]).splitlines() for day in days]
    head = [f"| km a day {tables[0][0]}", f"|---{tables[0][1]}"]
    return "\n".join(head + [f"| {1e-3 * day:g} {own[2]}" for day, own in zip(days, tables, strict=True)])


def follow_table() -> str:
    return follow.as_markdown(load_rows(RESULTS / "follow.jsonl"))


def follow_sum() -> str:
    _, *rows = estimate_pages.narrowed(follow_table(), (0, 1, 2, 3, 4, 5, 7))
    errors = ("forces, RMS [%]", "largest force [%]", "impulse [%]")
    lines = [[*row[:2], *(cell.replace(" %", "") for cell in row[2:5]), *row[5:]] for row in rows]
    return table(["group", "truths", *errors, "coverage of these three", "share of a core"], lines)


def follow_machines_table() -> str:
    return follow_machines.as_markdown(load_rows(RESULTS / "follow_machines.jsonl"))


def follow_latency() -> str:
    """Return the CPU times of live samples with an event, without following and with it."""
    with (RESULTS / "follow_latency.csv").open(newline="", encoding="utf-8") as file:
        rows = {(row["contact"], row["follow"], row["event"]): row for row in csv.DictReader(file)}
    lines = []
    for event in dict.fromkeys(event for _, _, event in rows):
        line = [event]
        for mode, key in (("off", "all_ms"), ("full", "first_ms"), ("full", "all_ms"), ("full", "later_ms")):
            values = [float(rows[contact, mode, event][key]) for contact in ("soft", "hard")]
            line.append(", ".join(f"{value:#.3g}".rstrip(".") for value in values))
        lines.append(line)
    return table(["event", "`off`: all", "`full`: until the forces", "`full`: all", "`full`: largest later"], lines)


def siconos() -> str:
    """Return a table that compares this solver with two references of Siconos for the slider of the literature."""
    with (RESULTS / "siconos.csv").open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["quantity"] != "largest gap function error"]
    names = [name for name in dict.fromkeys(row["reference"] for row in rows) if " against " not in name]
    head = ["quantity"]
    for name in names:
        head += [f"Siconos, {name.removeprefix('MoreauJean').removesuffix('OSI')}", "plow_twin"]
    lines = []
    for quantity in dict.fromkeys(row["quantity"] for row in rows):
        line = [quantity]
        for row in (row for name in names for row in rows if (row["reference"], row["quantity"]) == (name, quantity)):
            difference = row["unit"] == "clearance"
            line += (
                ["", f"{float(row['ours']):.2f}"] if difference else [_in_unit(row, key) for key in ("theirs", "ours")]
            )
        lines.append(line)
    return table(head, lines)


def _in_unit(row: dict[str, str], key: str) -> str:
    milli = {"s": "ms", "N s": "mN s"}[row["unit"]]
    return f"{1e3 * float(row[key]):.3g} {milli}"


FIGURES: dict[str, Callable[[], str]] = {
    "machine": machine, "speed": speed, "located": located, "work": work, "missed": missed,
    "random_scenes": random_scenes, "siconos": siconos, "lives": life_table, "lives_sum": life_sum,
    "month": month_table, "follow": follow_table, "follow_sum": follow_sum, "follow_latency": follow_latency,
    "follow_machines": follow_machines_table,
    **estimate_pages.FIGURES, **measured_pages.FIGURES,
    "measured_sum": measured_sum, "replay": replay, "tuning": tuning_sensitivity.table,
    **{
        name: stored(name)
        for name in ("live_node", "live_opcua", "estimate_forces", "estimate_scales", "estimate_live")
    },
}  # fmt: skip


def _many_twins(scene: str) -> str:
    _, rate, twins, call = scene.split(", ")
    return f"{twins} at {rate}, {call}"


def _own_ms(rows: Sequence[Row], scene: str, output_s: float, level: float, solver: str) -> float:
    reached = fastest(rows, scene, output_s, level, OWN[solver])
    assert reached is not None
    return reached.wall_ms


def _times(rows: Sequence[Row], scene: str, output_s: float, level: float, peer: str, own_ms: float) -> str:
    reached = fastest(rows, scene, output_s, level, PEERS[peer])
    return "not reached" if reached is None else f"{reached.wall_ms / own_ms:.1f}x"


def _short(verdict: targets.Verdict) -> str:
    ratio = re.search(r"\*\*([\d.]+x)\*\*", verdict.measured)
    return ratio[1] if ratio else verdict.measured
