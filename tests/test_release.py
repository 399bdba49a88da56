"""What a release is made of: one version everywhere, and the gallery's data as one file with its checksum."""

import hashlib
import re
import subprocess
import zipfile
from pathlib import Path

import pytest

import gradscape

ROOT = Path(__file__).parent.parent
NAME = f"gradscape-data-{gradscape.__version__}"


def archived(folder: Path) -> tuple[bytes, str]:
    """Make the archive of the data in a folder, and return its bytes and what its checksum file says."""
    subprocess.run(["make", "archive", f"DIST={folder}"], cwd=ROOT, check=True, capture_output=True)
    return (folder / f"{NAME}.zip").read_bytes(), (folder / f"{NAME}.zip.sha256").read_text()


def test_the_version_is_the_same_everywhere():
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert newest
    assert cited
    assert {newest[1], cited[1]} == {gradscape.__version__}


@pytest.mark.e2e
def test_the_data_is_one_file_whose_checksum_holds(tmp_path):
    content, said = archived(tmp_path / "once")
    assert said == f"{hashlib.sha256(content).hexdigest()}  {NAME}.zip\n"
    assert archived(tmp_path / "again")[0] == content
    listed = subprocess.run(
        ["git", "ls-tree", "-r", "-z", "--name-only", "HEAD", "gallery/data"], cwd=ROOT, check=True, capture_output=True
    )
    wanted = {f"{NAME}/{name}" for name in listed.stdout.decode().split("\0") if name}
    assert wanted
    with zipfile.ZipFile(tmp_path / "once" / f"{NAME}.zip") as archive:
        names = {name for name in archive.namelist() if not name.endswith("/")}
    assert names == wanted | {f"{NAME}/LICENSE", f"{NAME}/CITATION.cff"}
