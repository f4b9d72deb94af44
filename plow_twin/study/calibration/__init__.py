"""Unknowns of a scene fitted to figures or to a recording."""
