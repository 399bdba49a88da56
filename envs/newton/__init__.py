"""Scenes that Newton simulates; they need the extra `newton` of this package."""
