"""Methods that compute a step: free flight, rest, implicit steps and Taylor series (`method.protocol`)."""
