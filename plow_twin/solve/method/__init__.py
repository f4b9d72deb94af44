"""Methods that lay out a step: free flight, rest, implicit steps, Taylor series.

Each is a module that keeps the contract in `method.protocol`; the other modules serve one or more of them.
"""
