"""Simulation of whole motions, and live twins that are advanced in time."""
