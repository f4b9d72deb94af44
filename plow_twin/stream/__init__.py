"""Processing of the stream of samples, such as the order of stamps, gaps, the hold policy and counters."""
