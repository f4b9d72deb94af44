"""The solver: series, events and the loop that advances the motion, and fixed-step methods."""
