"""Methods that lay out a step: free flight, rest, implicit steps, Taylor series.

Each method is a module that keeps the contract in `method.protocol`; the other modules help one or more methods.
"""
