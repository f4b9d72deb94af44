"""Comparison of runs: quantities of contacts in time windows, and statistically significant changes."""
