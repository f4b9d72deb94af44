"""The machine: parameters, geometry, contact laws, loads; independent of time stepping."""
