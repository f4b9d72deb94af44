"""Samples over time: order, gaps, hold policy, health counters; every clock is passed in."""
