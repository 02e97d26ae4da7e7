"""A release: its files agree, and its wheel installs and runs where nothing else is installed."""

import json
import re
import shutil

import pytest

from scripts import release


def copied(folder):
    """The files that name a version, in another folder."""
    for name in release.versions():
        shutil.copy(release.ROOT / name, folder / name)
    return folder


def test_all_files_name_one_version():
    assert re.fullmatch(r"\d+\.\d+\.\d+(\.dev\d+)?", release.check_versions())


@pytest.mark.parametrize("name", list(release.versions()))
def test_a_version_that_differs_is_refused(name, tmp_path):
    path = copied(tmp_path) / name
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(release.check_versions(), "9.9.9"), encoding="utf-8")
    with pytest.raises(release.ReleaseError, match=rf"{name}: 9.9.9"):
        release.check_versions(tmp_path)


def test_a_file_without_a_version_is_refused(tmp_path):
    (copied(tmp_path) / "CHANGELOG.md").write_text("# Changelog\n", encoding="utf-8")
    with pytest.raises(release.ReleaseError, match="CHANGELOG.md: none"):
        release.check_versions(tmp_path)


def test_the_first_notebook_installs_before_it_imports(tmp_path):
    cells = json.loads(release.notebook(tmp_path).read_text(encoding="utf-8"))["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert "pip" in code[0] and ".whl" in code[0]
    assert not re.search(r"^(import|from) (jax|codesign_jax)", code[0], re.M)


@pytest.mark.slow  # downloads all dependencies; test_library installs the wheel without them
def test_a_release_installs_into_an_empty_environment_and_runs(tmp_path):
    assert release.main(["--out", str(tmp_path / "dist")]) == 0
    suffixes = {path.suffix for path in (tmp_path / "dist").iterdir()}
    assert suffixes == {".gz", ".whl", ".ipynb"}
