"""What the machine is: parameters, geometry, contact laws, loads. Knows nothing of time stepping."""
