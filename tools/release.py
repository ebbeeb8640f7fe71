"""Build, check and tag a release of a checkout, with a version that is committed: ``python tools/release.py 1.2.0``.

Source archive and wheel land in dist/. Nothing is pushed or published: the commands for it are printed.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from packaging.metadata import Metadata
from packaging.version import InvalidVersion, Version

from legged_torque.utils import cli
from legged_torque.utils.errors import UserError

INIT, CITATION, CHANGES = "legged_torque/__init__.py", "CITATION.cff", "CHANGELOG.md"
LINES = {INIT: '__version__ = "{}"', CITATION: "version: {}", CHANGES: "## {} (DATE)"}  # with a date like 2026-01-31
BUILD = "import sys; from setuptools import build_meta; print(getattr(build_meta, f'build_{sys.argv[1]}')('.'))"


def main() -> None:
    """Check the checkout, build, and only then write the files and the tag."""
    parser = cli.Parser(__doc__)
    parser.add_argument("version", help="that of the release, such as 1.2.0")
    version = parser.parse_args().version
    os.chdir(run("git", "rev-parse", "--show-toplevel"))
    check_version(version)
    cli.check_output(Path("dist", f"legged_torque-{version}.tar.gz"))
    with tempfile.TemporaryDirectory() as temporary:
        built, dist = build(Path(temporary), version), Path("dist")
        dist.mkdir(exist_ok=True)
        files = [shutil.copy(file, dist) for file in built]
        run("git", "tag", "-a", f"v{version}", "-m", f"legged_torque {version}")
    print(f"Tagged v{version}. To publish it:")
    print(f"  git push origin v{version}\n  python -m twine upload {' '.join(map(str, files))}")


def run(*words: str, folder: Path | None = None) -> str:
    """Return what a program prints in a folder; a UserError with its last line of errors if it fails."""
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        reason = (done.stderr.strip() or f"exit status {done.returncode}").splitlines()[-1]
        raise UserError(f"{Path(words[0]).name} {words[1]} fails: {reason}")
    return done.stdout.strip()


def check_version(version: str) -> None:
    """Raise a UserError for changes that are not committed, and a version that is not the next one everywhere."""
    try:
        tags = [Version(tag) for tag in run("git", "tag", "--list", "v[0-9]*").split()]
        number = Version(version)
    except InvalidVersion as error:
        raise UserError(error) from None
    if str(number) != version:
        raise UserError(f"the version must be written as {number}, not '{version}'")
    if tags and number <= max(tags):
        raise UserError(f"{version} is not newer than {max(tags)}, the last tag")
    if changes := run("git", "status", "--porcelain"):
        raise UserError(f"there are changes that are not committed: {', '.join(changes.splitlines())}")
    for file, line in LINES.items():
        pattern = re.escape(line.format(version)).replace("DATE", r"\d{4}-\d\d-\d\d")
        if not re.search(f"^{pattern}$", Path(file).read_text("utf-8"), re.MULTILINE):
            raise UserError(f"{file} lacks the line '{line.format(version)}'")


def build(folder: Path, version: str) -> list[Path]:
    """Return source archive and wheel in a folder, the wheel built from the archive; a UserError if one is broken."""
    run("git", "archive", "--format=tar", f"--output={folder / 'commit.tar'}", "HEAD")
    shutil.unpack_archive(folder / "commit.tar", folder / "commit")
    sdist = folder / "commit" / run(sys.executable, "-c", BUILD, "sdist", folder=folder / "commit").splitlines()[-1]
    shutil.unpack_archive(sdist, folder)
    source, site = folder / sdist.name.removesuffix(".tar.gz"), folder / "site"
    wheel = source / run(sys.executable, "-c", BUILD, "wheel", folder=source).splitlines()[-1]
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)  # this installs it, and Python looks in its own folder first
    (file,) = site.glob("*.dist-info/METADATA")
    metadata = Metadata.from_email(file.read_bytes())  # checked as the index does; an error is the program's
    answer = run(sys.executable, "-c", "from legged_torque.utils.command import main; main()", "--version", folder=site)
    if (str(metadata.version), answer) != (version, f"legged-torque {version}"):
        raise UserError(f"the wheel is of version {metadata.version}, and answers '{answer}'")
    return [sdist, wheel]


if __name__ == "__main__":
    cli.run_script(main)
