"""Pictures of recordings and of results: rerun files and PNG files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from plow_twin.view.rrd import ViewSummary as ViewSummary
    from plow_twin.view.rrd import to_rrd as to_rrd


def __getattr__(name: str) -> Any:
    """Import the rerun library on first use, because PNG files do not need it."""
    if name in ("ViewSummary", "to_rrd"):
        from plow_twin.view import rrd

        return getattr(rrd, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
