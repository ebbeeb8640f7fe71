"""A release of a repository that is made of these files, with real git and setuptools."""

import shutil
import subprocess
from pathlib import Path

from support.scripts import ROOT, assert_told_in_one_line, run_here

from legged_torque import __version__

UNWANTED = ".git", ".*cache*", ".venv", "build", "dist", "docs", "logs", "*.egg-info", "__pycache__"


def test_release(tmp_path):
    """Mistakes write nothing; then archive, wheel and tag are of the commit, and a second time is a mistake."""
    root = Path(shutil.copytree(ROOT, tmp_path / "root", ignore=shutil.ignore_patterns(*UNWANTED)))

    def git(*words):
        return subprocess.run(["git", "-C", root, *words], check=True, capture_output=True, text=True).stdout.split()

    git("init", "-q")
    (root / ".git" / "config").write_text("[user]\nname = me\nemail = me@here\n")
    for file in ("legged_torque/__init__.py", "CITATION.cff", "CHANGELOG.md"):
        assert_told_in_one_line(run_here("../tools/release.py", "7.1", root=root), "changes that are not committed: ")
        git("add", "-A")
        git("commit", "-qm", "all but the next file")
        assert_told_in_one_line(run_here("../tools/release.py", "7.1", root=root), f"{file} lacks the line '")
        text = (root / file).read_text("utf-8").replace("(unreleased)", "(2027-01-31)")
        (root / file).write_text(text.replace(__version__, "7.1", 1))
    git("commit", "-qam", "all")
    assert_told_in_one_line(run_here("../tools/release.py", "v7.1", root=root), "written as 7.1, not 'v7.1'")
    assert not git("tag") and not (root / "dist").exists()
    status, output, errors = run_here("../tools/release.py", "7.1", root=root)
    assert status == 0 and "git push origin v7.1\n" in output and "twine upload dist/" in output, errors
    assert git("rev-parse", "v7.1^{commit}") == git("rev-parse", "HEAD")
    assert sorted(file.suffix for file in root.glob("dist/legged_torque-7.1*")) == [".gz", ".whl"]
    assert_told_in_one_line(run_here("../tools/release.py", "7.1", root=root), "7.1 is not newer than 7.1")
