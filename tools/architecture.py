"""Draw `docs/images/architecture.svg`: the subpackages from the lowest to the highest, and the path of a sample.

python tools/architecture.py
"""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import escape

OUT = Path(__file__).resolve().parent.parent / "docs" / "images" / "architecture.svg"
WIDTH, ROW, GAP, LEFT = 920, 54, 14, 20
COLUMN = 470
#: Rows of subpackages from the top down; a subpackage imports only from rows below it.
SUBPACKAGES = (
    (("cli", "plow-twin"),),
    (("demo", "publisher, summary"), ("study", "calibration, sweep, analysis")),
    (("telemetry", "results to a plant"),),
    (("dashboard", "the operator's screen"),),
    (("ros", "the node"),),
    (("live", "runtime, bridges"),),
    (("record", "MCAP, replay"), ("view", "rerun")),
    (("stream", "intake, session, outputs"), ("estimate", "from measurements")),
    (("run", "simulate, Twin, TwinBatch, ensemble"),),
    (("scene_file", "YAML, presets"), ("solve", "step, events, loop; method/")),
    (("model", "scene, geometry, laws, loads"),),
    (("kernel", "compiler, SIMD, power series"),),
)
CORE = {"kernel", "model", "solve", "run"}
SAMPLE = (
    ("ros/input_loop, input_queue", "messages as they come | live/bridge: files, MQTT, OPC UA"),
    ("ros/subscriptions, live/inputs", "stamp and wrench; loss counted"),
    ("live/runtime: step", "samples in, messages out"),
    ("stream/driver, intake", "used, or dropped by a counted reason"),
    ("stream/session: advance", "journal, then apply | record/replay starts here"),
    ("run/twin, solve/loop: advance_rows", "steps from event to event; one row for a sample"),
    ("stream/outputs, live/publishing", "all since the last publication; bytes"),
    ("ros/front: send | record/recorder", "topics | MCAP"),
)


def box(x: float, y: float, width: float, title: str, text: str, fill: str) -> str:
    """Return a rectangle with a title and a line of text."""
    middle = x + width / 2
    return (
        f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{ROW - 8}" rx="5" fill="{fill}" stroke="#4a5a6a"/>'
        f'<text x="{middle:g}" y="{y + 19:g}" class="title">{escape(title)}</text>'
        f'<text x="{middle:g}" y="{y + 36:g}" class="text">{escape(text)}</text>'
    )


def drawing() -> str:
    """Return the picture as SVG."""
    top = 44
    parts = []
    for index, row in enumerate(SUBPACKAGES):
        width = (COLUMN - GAP * (len(row) - 1)) / len(row)
        for place, (name, text) in enumerate(row):
            fill = "#d7e6f4" if name in CORE else "#f3f0e6"
            parts.append(box(LEFT + place * (width + GAP), top + index * ROW, width, name, text, fill))
    x, width = LEFT + COLUMN + 60, WIDTH - COLUMN - LEFT - 80
    for index, (name, text) in enumerate(SAMPLE):
        y = top + index * ROW
        parts.append(box(x, y, width, name, text, "#e6f2e2"))
        if index:
            parts.append(f'<path d="M{x + width / 2:g} {y - 8:g} v7" class="arrow"/>')
    height = top + ROW * len(SUBPACKAGES) + 34
    base = top + ROW * len(SUBPACKAGES)
    parts.append(f'<path d="M{LEFT + COLUMN + 24} {top} V{base - 10}" class="arrow"/>')
    side = f'x="{LEFT + COLUMN + 40}" y="{(top + base) / 2:g}"'
    parts.append(
        f'<text {side} transform="rotate(90 {LEFT + COLUMN + 40} {(top + base) / 2:g})" class="text">imports</text>'
    )
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}">'
        "<style>text{font-family:sans-serif;text-anchor:middle;fill:#1c2733}.title{font-size:14px;font-weight:bold}"
        ".text{font-size:12px}.head{font-size:16px;font-weight:bold}.arrow{stroke:#4a5a6a;stroke-width:1.5;fill:none;"
        'marker-end:url(#tip)}</style><defs><marker id="tip" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="6" '
        'markerHeight="6" orient="auto"><path d="M0 0L10 5L0 10z" fill="#4a5a6a"/></marker></defs>'
        f'<rect width="{WIDTH}" height="{height}" fill="white"/>'
        f'<text x="{LEFT + COLUMN / 2:g}" y="26" class="head">subpackages</text>'
        f'<text x="{x + width / 2:g}" y="26" class="head">the way of a sample</text>'
        f'<text x="{LEFT + COLUMN / 2:g}" y="{base + 16}" class="text">blue: the core (numpy, scipy, numba)</text>'
    )
    return head + "\n".join(parts) + "</svg>\n"


if __name__ == "__main__":
    OUT.write_text(drawing(), encoding="utf-8")
