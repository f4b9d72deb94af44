"""Recordings turned into rerun files: what happened, moving in time."""
