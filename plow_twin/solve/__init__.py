"""The solver: Taylor series with event detection, the main loop, and fixed-step methods."""
