"""Methods that compute a step. They are free flight, rest, implicit steps and Taylor series.

Each method is a module with the functions of `method.protocol`. All further modules contain helpers of the methods.
"""
