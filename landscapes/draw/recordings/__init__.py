"""Recordings that play back in three dimensions (rerun)."""
