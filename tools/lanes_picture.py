"""Draw `docs/images/lanes.svg`: one step in the lanes of a vector (`plow_twin/solve/lanes/`).

python tools/lanes_picture.py
"""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import escape

OUT = Path(__file__).resolve().parent.parent / "docs" / "images" / "lanes.svg"
WIDTH, HEIGHT, LEFT, ROW, CELL = 920, 330, 96, 34, 66
#: Four of the eight lanes. Each has a scene and slots, which hold the pairs that act.
LANES = (
    ("scene 17", ("a-top",)),
    ("scene 4", ("b-right", "d-left", "d-bottom")),
    ("scene 22", ()),
    ("scene 9", ("c-bottom", "d-bottom")),
)
#: Guards that may end the steps. The first guard of each lane comes first; the remaining place has the second guard of
#: lane 0.
ROUND = (("lane 0: b-right",), ("lane 1: d-left",), ("lane 2: a-left",), ("lane 0: c-bottom",))
#: Ends of steps in each lane. Each end has its place as a share of the width and its kind: "step", "event" or "next
#: scene".
STEPS = (
    ((0.18, "step"), (0.30, "event"), (0.55, "step"), (0.80, "step")),
    ((0.10, "event"), (0.22, "event"), (0.48, "step"), (0.66, "event")),
    ((0.33, "step"), (0.62, "step"), (0.78, "next scene"), (0.92, "event")),
    ((0.14, "step"), (0.37, "step"), (0.50, "event"), (0.74, "step")),
)
DOES = {
    "series": "all lanes, one linear map of the forces each",
    "step size": "each lane's own",
    "guards, roots": "eight guards of any lanes a round",
    "totals": "one acting pair of each lane a slot",
    "modes": "lane by lane; a finished scene gives way",
}
COLOURS = {"step": "#4a5a6a", "event": "#b3402a", "next scene": "#2f7d3b"}
FILLS = {"slot": "#d7e6f4", "round": "#f4dcd2", "empty": "#f7f7f4"}


def text(x: float, y: float, content: str, style: str = "text") -> str:
    """Return a line of text about x."""
    return f'<text x="{x:g}" y="{y:g}" class="{style}">{escape(content)}</text>'


def timelines(top: float) -> list[str]:
    """Return each lane's own time with the ends of its steps."""
    parts, width = [], WIDTH - LEFT - 30
    for lane, steps in enumerate(STEPS):
        y = top + lane * 24
        parts += [text(LEFT - 44, y + 4, f"lane {lane}"), f'<path d="M{LEFT} {y} h{width}" class="line"/>']
        for number, (share, kind) in enumerate(steps, 1):
            x = LEFT + share * width
            parts.append(f'<path d="M{x:g} {y - 6} v12" stroke="{COLOURS[kind]}" stroke-width="3"/>')
            parts.append(f'<text x="{x - 9:g}" y="{y - 3}" class="small">{number}</text>')
    for place, (kind, colour) in enumerate(COLOURS.items()):
        x = LEFT + 90 + place * 190
        parts.append(f'<path d="M{x} {top + 92} v12" stroke="{colour}" stroke-width="3"/>')
        parts.append(text(x + 62, top + 102, f"step ends: {kind}" if place < 2 else kind))
    return parts


def cells(
    left: float, top: float, kind: str, names: tuple[tuple[str, ...], ...], columns: int, cell: float = CELL
) -> list[str]:
    """Return a table with the pair or guard at each place of each slot or round."""
    parts = [text(left + (i + 0.5) * cell, top - 6, f"{kind} {i}", "small") for i in range(columns)]
    for place, row in enumerate(names):
        for i in range(columns):
            name, x, y = (row[i] if i < len(row) else ""), left + i * cell, top + place * ROW
            fill = FILLS[kind if name else "empty"]
            parts.append(f'<rect x="{x:g}" y="{y:g}" width="{cell - 4:g}" height="{ROW - 6}" rx="4" fill="{fill}"/>')
            parts.append(text(x + cell / 2 - 2, y + 18, name, "small"))
    return parts


def drawing() -> str:
    """Return the picture as SVG."""
    top, parts = 178, timelines(34)
    for lane, (scene, _) in enumerate(LANES):
        parts.append(text(LEFT - 44, top + lane * ROW + 18, scene))
    parts += cells(LEFT, top, "slot", tuple(slots for _, slots in LANES), 3)
    parts += cells(LEFT + 3.6 * CELL, top, "round", ROUND, 1, 1.7 * CELL)
    x = LEFT + 6.2 * CELL
    for number, (phase, does) in enumerate(DOES.items()):
        y = top - 8 + number * 28
        parts.append(f'<rect x="{x:g}" y="{y}" width="{WIDTH - x - 30:g}" height="22" rx="5" fill="#e6f2e2"/>')
        parts.append(text((x + WIDTH - 30) / 2, y + 15, f"{phase}: {does}"))
    style = (
        "text{font-family:sans-serif;text-anchor:middle;fill:#1c2733}.text{font-size:12px}.small{font-size:11px}"
        ".line{stroke:#9aa5b0;stroke-width:1.5;fill:none}"
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}">'
        f'<style>{style}</style><rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>' + "\n".join(parts) + "</svg>\n"
    )


if __name__ == "__main__":
    OUT.write_text(drawing(), encoding="utf-8")
