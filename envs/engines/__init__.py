"""Simulation engines: the only place that knows Warp or Taichi."""
