"""Offline questions asked of many runs: sweeps of a scene, calibration against figures or recordings, analysis.

matplotlib, pyarrow, jinja2 and distributed are imported where they are used (extras `study` and `dask`).
"""
