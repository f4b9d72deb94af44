"""Statistics of a motion as functions of one or two parameters."""
