"""Recordings as rerun files and pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from plow_twin.view.rrd import ViewSummary as ViewSummary
    from plow_twin.view.rrd import to_rrd as to_rrd


def __getattr__(name: str) -> Any:
    """Import the viewer's library on first use, because a picture does not need it."""
    if name in ("ViewSummary", "to_rrd"):
        from plow_twin.view import rrd

        return getattr(rrd, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
