"""The picture of random numbers, and mistakes in its command line."""

import sys

import pytest
from support.scripts import assert_told_in_one_line, run_here


def plot(tmp_path, *words):
    """Run the script on the CPU with few worlds; return the result and the picture's path."""
    file = tmp_path / "new" / "picture.png"
    return run_here(
        "plot.py", "randomization", "--device=cpu", "--num_envs=12", f"--out={file}", *words, root=tmp_path
    ), file


@pytest.mark.parametrize(
    "words",
    [
        ("--perturbation=none", "--set=motors.delay.range=[1, 4]", "--set=domain_rand.keep_fixed=[gravity]"),
        ("--task=a1_torque_multihead", "--perturbation=doubled", "--set=env.history_length=3"),
    ],
)
def test_picture(tmp_path, words):
    """It is an image that can be read, whatever is drawn or not."""
    matplotlib_image = pytest.importorskip("matplotlib.image", reason="needs the extra: pip install -e .[plots]")
    result, file = plot(tmp_path, *words)
    assert result == (0, "", "")
    height, width, _ = matplotlib_image.imread(file).shape
    assert 1000 < width < 2500 and 1000 < height < 2500
    assert 20_000 < file.stat().st_size < 400_000


def test_mistakes(tmp_path):
    """They are refused in one line, with exit status 2, and nothing is written."""
    result, _ = plot(tmp_path, "--set=domain_rand.keep_fixed=[gravitation]")
    assert_told_in_one_line(result, "'gravitation'; did you mean 'gravity'?")
    assert not list(tmp_path.iterdir())


def test_without_matplotlib(tmp_path, monkeypatch):
    """The extra that is missing is named."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    result, _ = plot(tmp_path)
    assert_told_in_one_line(result, "pip install 'legged_torque[plots]'")
