"""The demo, which runs a publisher of the load and the node with its recorder, and prints a summary of the run."""
