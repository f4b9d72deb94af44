"""Tools for all compiled functions (compiler, SIMD lanes, polynomials), independent of the machine."""
