"""Runs: every point that an optimiser evaluated, in memory and on disk."""
