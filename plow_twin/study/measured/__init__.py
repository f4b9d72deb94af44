"""Comparison of the contact model with published measurements: impacts of an ellipse, drops of a square.

Data: Fazeli and others, in DAIRLab/ImpactModeling (BSD-3-Clause); `docs/measured.md`.
"""

from plow_twin.study.measured.ellipse import impact
from plow_twin.study.measured.square import bands

__all__ = ["bands", "impact"]
