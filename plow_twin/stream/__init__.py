"""The stream of samples over time: order, gaps, hold policy and health counters. No module here reads a clock."""
