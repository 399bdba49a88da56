"""What tests assert of a simulator: `gradscape.testing.assert_gradients(f)`."""

from .api.testing import assert_gradients

__all__ = ["assert_gradients"]
