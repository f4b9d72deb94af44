"""Offline studies of many runs: sweeps of a scene, calibration to figures or recordings, analysis of recordings.

The optional packages matplotlib, pyarrow, jinja2 and distributed (extras `study` and `dask`) are imported only where
they are used.
"""
