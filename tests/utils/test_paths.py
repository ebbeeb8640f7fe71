"""No committed file names a folder of one machine."""

from pathlib import Path

from legged_torque.utils.files import portable_path, without_machine


def test_portable_path(tmp_path, monkeypatch):
    """Paths below the current folder become relative, others a name; relative ones stay."""
    monkeypatch.chdir(tmp_path)
    assert portable_path(tmp_path / "logs" / "a.pt") == "logs/a.pt"
    assert portable_path("/elsewhere/a.pt") == "a.pt"
    assert portable_path(Path("../logs/a.pt")) == "../logs/a.pt"


def test_without_machine(monkeypatch, tmp_path):
    """Paths are found in nested settings and in KEY=VALUE; everything else stays."""
    monkeypatch.chdir(tmp_path)
    settings = {
        "file": "/tmp/a.pt",
        "scale": 0.5,
        "empty": "",
        "names": ["a/b", "runner.file=/tmp/b.pt", "x=1/2", None],
    }
    expected = {"file": "a.pt", "scale": 0.5, "empty": "", "names": ["a/b", "runner.file=b.pt", "x=1/2", None]}
    assert without_machine(settings) == expected
