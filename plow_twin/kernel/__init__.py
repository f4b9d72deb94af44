"""The compiler, SIMD lanes and polynomials that every compiled function uses; independent of the machine."""
