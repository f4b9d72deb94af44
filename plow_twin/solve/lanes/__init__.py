"""Computation of eight scenes in SIMD vectors. Each lane runs one scene with its own steps, times, modes and events."""
