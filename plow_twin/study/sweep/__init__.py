"""Statistics over a grid of two parameters."""
