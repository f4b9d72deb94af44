"""Computation of eight scenes in SIMD vectors. Each lane runs one scene with its own steps, modes and events."""
