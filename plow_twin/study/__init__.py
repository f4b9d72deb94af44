"""Offline studies of many runs: sweeps of a scene, calibration, and analysis of recordings.

The optional packages matplotlib, pyarrow, jinja2 and distributed (extras `study` and `dask`) are imported where they
are used.
"""
