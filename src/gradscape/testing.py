"""Assertions about a simulator for your own tests: `gradscape.testing.assert_gradients(f)`."""

from .api.testing import assert_gradients

__all__ = ["assert_gradients"]
