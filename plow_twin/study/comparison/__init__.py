"""Comparison of runs: windows of their contacts, and statistically significant changes."""
