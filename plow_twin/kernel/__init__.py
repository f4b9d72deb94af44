"""What every compiled function stands on: the compiler, SIMD lanes, polynomials. Knows nothing of the machine."""
