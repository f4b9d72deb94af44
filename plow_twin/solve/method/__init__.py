"""Methods that compute a step: free flight, rest, implicit steps and Taylor series.

Each method is a module with the functions of `method.protocol`. The other modules contain helpers of these methods.
"""
