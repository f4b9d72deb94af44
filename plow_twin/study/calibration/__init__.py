"""Fit of a scene's unknown parameters to published figures or to a recording."""
