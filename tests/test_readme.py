"""The README's worked examples run as they stand."""

import json
import re
import subprocess
import sys
from pathlib import Path

from gradscape.gallery.figures import DATA, read_figures
from gradscape.measure_tables import environments_table

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def test_the_worked_example_runs_in_under_30_lines(tmp_path: Path) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    assert sum(bool(line.strip()) for line in example.splitlines()) < 30
    done = subprocess.run([sys.executable, "-c", example], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert 0 <= float(done.stdout) < 0.1  # the target can be hit
    assert (tmp_path / "throw.png").read_bytes().startswith(b"\x89PNG")


def test_the_example_package_registers_an_environment(tmp_path: Path) -> None:
    package = ROOT / "docs/example_package"
    entry = re.search(r'gradscape.environments"\]\n(.*?)\n\n', (package / "pyproject.toml").read_text(), re.DOTALL)
    assert entry
    assert entry[1] in README
    info = tmp_path / "throw_env-0.1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: throw-env\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text("[gradscape.environments]\n" + entry[1].replace('"', "") + "\n")
    command = [sys.executable, "-m", "gradscape", "slice", "throw", "--dims", "angle", "speed", "--resolution", "5"]
    path = {"PYTHONPATH": f"{tmp_path}:{package}", "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}
    done = subprocess.run(command, cwd=tmp_path, env=path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "25 ok" in done.stderr


def test_every_picture_and_file_the_readme_names_is_there() -> None:
    named = [name for name in re.findall(r"\]\(([^)]+)\)", README) if "://" not in name]
    assert len(named) >= 3
    assert [name for name in named if not (ROOT / name.partition("#")[0]).exists()] == []
    headings = {name: _headings(ROOT / name.partition("#")[0]) for name in named if "#" in name}
    assert [name for name, there in headings.items() if name.partition("#")[2] not in there] == []


def _headings(file: Path) -> set[str]:
    """Return the anchors that headings have on GitHub."""
    titles = re.findall(r"^#+ (.+)$", file.read_text(), flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}


def test_the_table_of_environments_is_what_the_reports_say() -> None:
    """It stands between two marks, and nowhere without reports; a failure prints what has to stand there."""
    files = [DATA / figure.id / "report.json" for figure in read_figures()]
    records = [json.loads(file.read_text()) for file in files if file.exists()]
    found = re.findall(r"<!-- measured -->\n\n(.*?)\n<!-- /measured -->", README, flags=re.DOTALL)
    wanted = [environments_table(records)] if records else []
    assert found == wanted, "between <!-- measured --> and <!-- /measured --> has to stand:\n\n" + "\n".join(wanted)
