"""Files of a report: a self-contained HTML page, and JSON and CSV files."""

from __future__ import annotations

import base64
import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plow_twin.record.durable import whole_file, write_whole
from plow_twin.view.figures import signed

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def require(*modules: str) -> None:
    """Raise `ModuleNotFoundError` if a module is missing, before a long computation begins."""
    for module in modules:
        import_module(module)


def write_html(path: Path, template: str, context: Mapping[str, Any], package: str = "plow_twin.study") -> None:
    """Render the template `templates/<template>` of a package to an HTML file. The filter `image` embeds a PNG file."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader(package),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["image"] = lambda picture: _embedded(picture.read_bytes())
    environment.filters["percent"] = percent
    write_whole(path, environment.get_template(template).render(context).encode())


def embedded_figure(figure: Figure) -> str:
    """Return a matplotlib figure as the data URL of an image."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    stream = io.BytesIO()
    FigureCanvasAgg(figure).print_png(stream)  # type: ignore[no-untyped-call]
    return _embedded(stream.getvalue())


def _embedded(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def percent(share: float | None) -> str:
    """Return a share as a signed percentage such as +3.5 %, or an empty text for None."""
    return "" if share is None else signed(100.0 * share, "+.1f") + " %"


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a mapping as JSON. Numbers that are not finite become null."""
    text = json.dumps(_plain(document), indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    write_whole(path, text.encode())


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Path):
        return value.as_posix()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows, which have equal keys, as CSV."""
    with whole_file(path) as stream, io.TextIOWrapper(stream, encoding="utf-8", newline="") as text:
        writer = csv.DictWriter(text, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
