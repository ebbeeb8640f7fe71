"""Learning curves: one reader for every file that holds them, and plot_curves.py that draws them."""

import gzip
import json
import math
import shutil

import pytest
import yaml
from support.reports import HEADER, line
from support.scripts import assert_told_in_one_line, run_here
from support.settings import error_of

from legged_torque.paper.report.curves import CURVE_METRICS, read_curves

METRICS = [metric.name for metric in CURVE_METRICS]


@pytest.fixture
def files(tmp_path):
    """The same curve as a run's evaluations, as JSON of evaluate.py, and twice as evaluations of a report."""
    lines = [line(1, 0.1), line(2, 0.2, height="")]
    (tmp_path / "config.yaml").write_text(
        yaml.safe_dump({"task": "a1_torque", "env": {}, "train": {"seed": 3}, "versions": {}})
    )
    (tmp_path / "evaluations.csv").write_text("\n".join([HEADER, *lines]) + "\n")
    points = [{"steps": 1_000_000 * i, **dict.fromkeys(METRICS, float(i)), "track_percentage": 0.1 * i} for i in (1, 2)]
    (tmp_path / "curve.json").write_text(json.dumps({"task": "a1_torque", "seed": 3, "points": points}))
    rows = [f"a1_torque,{name},3,{text}" for name in ("low", "high") for text in lines]
    text = "\n".join([f"task,environment,seed,{HEADER}", *rows]) + "\n"
    (tmp_path / "evaluations.csv.gz").write_bytes(gzip.compress(text.encode()))
    return [tmp_path / name for name in ("evaluations.csv", "curve.json", "evaluations.csv.gz")]


def test_one_reader(files):
    """Every file has the task, the seed and the rows; a report's file has a curve per training."""
    names = [["a1_torque, seed 3"], ["a1_torque, seed 3"], ["a1_torque, low, seed 3", "a1_torque, high, seed 3"]]
    for file, expected in zip(files, names, strict=True):
        curves = read_curves(file)
        assert [str(curve) for curve in curves] == expected
        for curve in curves:
            assert (curve.task, curve.seed) == ("a1_torque", 3)
            assert [row["steps"] for row in curve.rows] == [1_000_000, 2_000_000]
            assert [row["track_percentage"] for row in curve.rows] == pytest.approx([0.1, 0.2])
            assert math.isnan(curve.rows[1]["height"]) == (file.suffix != ".json")


def test_files_that_hold_no_curves(files, tmp_path):
    """They are refused by their name."""
    (tmp_path / "other.json").write_text('{"task": "a1_torque"}')
    (tmp_path / "half.json").write_text('{"task": "a1_torque", "seed": 1, "points": [{"track_xy": 1}]}')
    (tmp_path / "text.csv.gz").write_text("no gzip")
    (tmp_path / "alone").mkdir()
    shutil.copy(files[0], tmp_path / "alone")
    for name, message in {
        "none.csv": "cannot read",
        "other.json": "is not a file that evaluate.py has written",
        "half.json": "does not hold learning curves: KeyError('steps')",
        "text.csv.gz": "cannot read",
        "alone/evaluations.csv": "has no config.yaml",
    }.items():
        assert message in error_of(read_curves, tmp_path / name)


def test_plot_curves(files, tmp_path):
    """All kinds of files go into one figure; a wrong file is told in one line."""
    pytest.importorskip("matplotlib", reason="figures need matplotlib: pip install -e .[plots]")
    picture = tmp_path / "new" / "curves.svg"
    result = run_here("plot_curves.py", *map(str, files), f"--out={picture}", root=tmp_path)
    assert result == (0, "", "")
    text = picture.read_text()
    assert text.count("<!-- Default torque, seed 3 -->") == 2 and "<!-- Default torque, high, seed 3 -->" in text
    assert "<!-- Cost of transport -->" in text
    result = run_here("plot_curves.py", str(tmp_path / "none.json"), f"--out={picture}", root=tmp_path)
    assert_told_in_one_line(result, "cannot read")
