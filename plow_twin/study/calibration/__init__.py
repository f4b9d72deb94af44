"""Fit of the unknown parameters of a scene to published figures or to a recording."""
