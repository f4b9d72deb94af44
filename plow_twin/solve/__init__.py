"""The solver. It consists of Taylor series with event detection, the main loop, and fixed-step methods."""
