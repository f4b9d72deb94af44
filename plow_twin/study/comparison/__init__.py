"""Comparison of runs: windows of their contacts, and changes that are more than chance."""
