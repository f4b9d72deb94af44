"""Analysis of recordings: comparison of predictions with measurements, and loads of the contacts."""
