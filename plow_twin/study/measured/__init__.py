"""Bodies that others have measured: impacts of an ellipse, drops of a square, held against the contact model.

Data: Fazeli and others, in DAIRLab/ImpactModeling (BSD-3-Clause); `docs/measured.md`.
"""

from plow_twin.study.measured.ellipse import impact
from plow_twin.study.measured.square import bands

__all__ = ["bands", "impact"]
