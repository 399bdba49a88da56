"""What a run of the tests says last."""

from types import SimpleNamespace

import pytest

from .command import NO_BROWSER
from .conftest import pytest_sessionfinish


@pytest.mark.parametrize(("reasons", "said"), [([], 0), (["no CUDA device"], 0), ([NO_BROWSER, "else", NO_BROWSER], 2)])
def test_a_run_without_chromium_says_how_many_tests_it_left_out_and_what_installs_it(
    reasons: list[str], said: int
) -> None:
    lines: list[str] = []
    skipped = [SimpleNamespace(longrepr=("test_pages.py", 1, f"Skipped: {reason}")) for reason in reasons]
    reporter = SimpleNamespace(stats={"skipped": skipped}, write_line=lines.append)
    plugins = SimpleNamespace(get_plugin={"terminalreporter": reporter}.get)
    for _ in pytest_sessionfinish(SimpleNamespace(config=SimpleNamespace(pluginmanager=plugins))):
        assert lines == []  # after all that pytest says itself
    assert [line.partition(" ")[0] for line in lines] == [str(said)][: said > 0]
    assert all("`apt-get install -y chromium`" in line for line in lines)
