"""Skip the tests of Taichi, whose modules import it, where there is none."""

from importlib.util import find_spec
from pathlib import Path

import pytest


class Skipped(pytest.Module):
    """A module of tests that is not imported."""

    def collect(self) -> list[pytest.Item]:
        """Say why nothing is collected."""
        pytest.skip("Taichi has no wheels past Python 3.12", allow_module_level=True)


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> pytest.Module | None:
    """Take such a module in the place of one that needs Taichi."""
    return None if find_spec("taichi") else Skipped.from_parent(parent, path=module_path)
