"""Many scenes in one SIMD vector: each lane is a scene with its own step, time, modes and events (`loop`)."""
