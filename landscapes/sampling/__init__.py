"""Sampling a slice: the order of its points, its memory, and its workers."""
