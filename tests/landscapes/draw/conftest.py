"""What tests of pictures share."""

import pytest


@pytest.fixture
def blank() -> None:
    """Leave no picture blank: here they are what is looked at."""
