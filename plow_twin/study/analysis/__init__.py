"""Analysis of recordings: predicted against measured, loads of the contacts, other scenes beside."""
