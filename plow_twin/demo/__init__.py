"""The demo: a publisher of excitation, the node and its recorder as processes, and a summary of the recording."""
