"""Calls of the library's user: motions from start to end, single or in batches, offline or live."""
