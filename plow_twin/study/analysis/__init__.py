"""Recordings analysed: predicted against measured, loads of the contacts, other scenes beside it."""
