"""Names of the services of a live twin, each a method of `Services`."""

from __future__ import annotations

from typing import Final

SERVICES: Final = (
    "reset",
    "switch_publisher",
    "set_wear",
    "acknowledge_alarms",
    "snapshot",
    "restore",
    "mark",
    "forecast",
)
