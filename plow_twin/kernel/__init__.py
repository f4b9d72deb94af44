"""Tools of all compiled functions (compiler, SIMD lanes, polynomials), which know nothing of the machine."""
