"""Simulators that others wrote beside ours: the same scene, the same machine, the same run."""
