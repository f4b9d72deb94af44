"""Recordings turned into rerun files and pictures: what happened, moving in time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from plow_twin.view.rrd import ViewSummary as ViewSummary
    from plow_twin.view.rrd import to_rrd as to_rrd


def __getattr__(name: str) -> Any:
    """Import the viewer's library only for what needs it: a picture does not."""
    if name in ("ViewSummary", "to_rrd"):
        from plow_twin.view import rrd

        return getattr(rrd, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
