"""Processing of the stream of samples: order of stamps, gaps, hold policy and health counters, without a clock."""
