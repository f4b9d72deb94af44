"""The compiler, SIMD lanes and polynomials that every compiled function uses. Knows nothing of the machine."""
