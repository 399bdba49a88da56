"""Runs: every point that an optimiser evaluated, in memory and on disk."""

RUN = "run.zarr"  # what the store of a run is called in its folder
