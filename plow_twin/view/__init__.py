"""Recordings turned into rerun files: what happened, moving in time."""

from plow_twin.view.rrd import ViewSummary as ViewSummary
from plow_twin.view.rrd import to_rrd as to_rrd
