"""The demo: a publisher of excitation and the node with its recorder, as processes, and a summary of the recording."""
