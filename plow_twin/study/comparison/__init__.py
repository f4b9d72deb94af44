"""Comparison of runs: contact forces, impacts and wear in time windows, and the significance of their changes."""
