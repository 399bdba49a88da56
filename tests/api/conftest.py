"""What tests of the front door share."""

import pytest


@pytest.fixture(autouse=True)
def undrawn(blank: None) -> None:
    """Leave pictures blank, but in tests marked `drawn`: calls write them beside what is asked of most tests."""
