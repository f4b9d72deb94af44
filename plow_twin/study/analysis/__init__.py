"""Analysis of recordings: predictions compared with measurements, loads of the contacts, and other scenes."""
