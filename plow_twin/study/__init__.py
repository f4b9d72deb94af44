"""Offline studies of many runs: sweeps of a scene, calibration to figures or recordings, analysis of recordings.

matplotlib, pyarrow, jinja2 and distributed (extras `study` and `dask`) are imported where they are used.
"""
