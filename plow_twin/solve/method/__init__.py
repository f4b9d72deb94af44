"""Ways to lay out a step: free flight, rest, implicit, Taylor series."""
