"""Motions from start to end, one or many, offline or live: what a user of the library calls."""
