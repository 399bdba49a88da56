"""Scenes to walk around in and to play back (rerun)."""
