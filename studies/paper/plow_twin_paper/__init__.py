"""Comparison of the paper's published figures with this model."""
