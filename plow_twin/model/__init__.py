"""Parameters, geometry, contact laws and loads of the machine, independent of the method of solution.

Docstrings call the publication Mao, Zhang et al. (2015) "the paper" (docs/study.md).
"""
