"""Runs written to MCAP files and read back: messages, recorder, reader and replay."""
