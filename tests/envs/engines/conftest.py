"""Engines are tested on the CPU, whose results are the same every time."""

from collections.abc import Iterator

import pytest
import warp as wp


@pytest.fixture(autouse=True, scope="package")
def cpu() -> Iterator[None]:
    with wp.ScopedDevice("cpu"):
        yield
