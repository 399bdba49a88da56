"""Scenes that MuJoCo simulates, in JAX; they need the extra `mjx` of this package."""
