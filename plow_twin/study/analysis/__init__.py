"""Recordings analysed: predicted against measured, what the contacts bore, other scenes beside it."""
