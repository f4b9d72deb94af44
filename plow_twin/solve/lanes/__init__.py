"""Eight scenes in one SIMD vector; each lane runs a scene with its own steps, times, modes and events (`loop`)."""
