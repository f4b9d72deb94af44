"""The published figures of the paper beside this model."""
