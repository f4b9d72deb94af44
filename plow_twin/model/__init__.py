"""The machine: its parameters, geometry, contact laws and loads. Nothing here depends on the method of solution."""
