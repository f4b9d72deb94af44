"""Estimates of clearance, contact and load from the measured motion of the head, each with an interval."""
