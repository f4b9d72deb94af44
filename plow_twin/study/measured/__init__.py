"""Comparison of the contact model with published measurements: impacts of an ellipse, and drops of a square.

The data are from Fazeli and others, in DAIRLab/ImpactModeling (BSD-3-Clause); see `docs/measured.md`.
"""

from plow_twin.study.measured.ellipse import impact
from plow_twin.study.measured.square import bands

__all__ = ["bands", "impact"]
