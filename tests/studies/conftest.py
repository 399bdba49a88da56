"""What tests of studies share: measurements are kept in a folder of the test's own."""

from pathlib import Path

import pytest

from gradscape.studies import samples


@pytest.fixture(autouse=True)
def kept_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep measurements in the test's folder `data`, and estimate what jobs take by one episode."""
    monkeypatch.setattr("gradscape.studies.own_folder.user_data_path", lambda name: tmp_path / "data" / name)
    for name in ("MOMENT", "ENOUGH", "WARM_UP"):
        monkeypatch.setattr(f"gradscape.landscapes.cost.{name}", 0.0)


@pytest.fixture
def few_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let intervals be coarse, as a test that does not look at them may."""
    monkeypatch.setattr(samples, "RESAMPLES", 99)
