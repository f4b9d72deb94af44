"""Runs compared with each other: windows of their contacts, and changes that are more than chance."""
