"""Solvers in Taichi, the independent reference."""
