"""The scripts that look at gravity pre-training: how often controller and policy stand, and pictures of a report."""

import json
import re
import sys

import pytest
import torch
from support.scripts import ROOT, assert_told_in_one_line, contents, run_here

from legged_torque.paper.gravity import pretraining as gravity_pretraining

TASK = "a1_torque_gravity"
SMALL = ["--device=cpu", "--num_envs=6"]
FEW = {"num_configurations": 12, "num_steps": 3, "num_rounds": 2, "num_epochs": 1, "held_out": 0.3}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder in which pretrain_gravity.py has made a small policy: the folder, its file, the report's file."""
    root = tmp_path_factory.mktemp("pretrained")
    words = [*SMALL, *(f"--set=pretraining.{name}={value}" for name, value in FEW.items())]
    report = root / "new" / "report.json"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gravity_pretraining, "STANDING_SECONDS", 0.1)  # not looked at here
        status, output, error = run_here("pretrain_gravity.py", *words, f"--json={report}", root=root)
    assert (status, error) == (0, ""), output + error
    return root, root / "logs" / "pretrained" / f"{TASK}.pt", report


# ------------------------------------------------------------------------------------------------- check_standing.py


def test_who_stands(made, tmp_path):
    """The controller stands nearly always, acting at 200 Hz or at 50 Hz; a policy of constant torques never does.

    The mean torque of a policy that says 0.5 for every joint is 2 N m.
    """
    root, file, _ = made
    content = torch.load(file, weights_only=True)
    *_, weight, bias = (name for name in content["actor_state_dict"] if name.startswith("mlp."))
    content["actor_state_dict"][weight][:] = 0.0
    content["actor_state_dict"][bias][:] = 0.5
    changed = tmp_path / "changed.pt"
    torch.save(content, changed)
    before = contents(root)
    status, output, error = run_here("check_standing.py", *SMALL, f"--set=pretraining.file={changed}", root=root)
    assert (status, error) == (0, "") and contents(root) == before
    head, *rows = output.splitlines()
    assert head.split() == ["frequency", "after", "standing", "mean", "torque"]
    pattern = r"(controller|policy) +(\d+) Hz +(\d) s +([\d.]+)% +([\d.]+) N m"
    rows = [re.fullmatch(pattern, row).groups() for row in rows]
    assert [row[:3] for row in rows] == [("controller", "200", "3"), ("controller", "50", "5"), ("policy", "50", "5")]
    for *_, share, torque in rows[:2]:
        assert 80.0 < float(share) <= 100.0 and 1.0 < float(torque) < 8.0
    assert rows[2][3:] == ("0.0", "4.00")


def test_standing_of_a_missing_policy(tmp_path):
    """It is told in one line where the policy should be; nothing is made."""
    result = run_here("check_standing.py", *SMALL, root=tmp_path)
    told = (
        f"no pre-trained policy 'logs/pretrained/{TASK}.pt'; make it first: python {ROOT}/scripts/pretrain_gravity.py"
    )
    assert_told_in_one_line(result, told)
    assert result[1] == "" and not list(tmp_path.iterdir())


def test_standing_of_a_policy_that_does_not_fit(made):
    """It is refused, as in training."""
    result = run_here("check_standing.py", *SMALL, "--set=control.torque_scale=5", root=made[0])
    assert_told_in_one_line(result, "its control.torque_scale is 8.0, here it is 5.0")


# ---------------------------------------------------------------------------------------------- plot_pretraining.py


def plot(file, folder, *words):
    """Draw a report; return the result and the picture's path, in a folder that is not there yet."""
    picture = folder / "new" / "picture.png"
    return run_here("plot_pretraining.py", str(file), f"--out={picture}", *words, root=folder), picture


def test_picture(made, tmp_path):
    """It is an image of four panels in a row, and shows the report: another one gives another picture."""
    matplotlib_image = pytest.importorskip("matplotlib.image", reason="needs the extra: pip install -e .[plots]")
    result, picture = plot(made[2], tmp_path)
    assert result == (0, "", "")
    image = matplotlib_image.imread(picture)
    height, width, _ = image.shape
    assert 1500 < width < 3000 and 3.0 < width / height < 6.0
    assert 20_000 < picture.stat().st_size < 400_000
    report = json.loads(made[2].read_text())
    report["standing"]["policy"] = 0.25  # of 6 worlds, never so
    changed = tmp_path / "changed.json"
    changed.write_text(json.dumps(report))
    result, picture = plot(changed, tmp_path)
    assert result == (0, "", "")
    differs = (matplotlib_image.imread(picture) != image).any(axis=2).any(axis=0).nonzero()[0]
    assert len(differs) and differs.min() > 0.7 * width  # in the last panel alone


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot read"),
        ("this is no report\n", "cannot read"),
        ("\xff\xfe", "cannot read"),
        ("[1, 2]", "is not a file that pretrain_gravity.py has written"),
        ('{"settings": {}, "standing": {}, "rms_error": {}}', "is not a file that pretrain_gravity.py has written"),
        ('{"settings": {}, "standing": {}, "rms_error": {}, "histograms": {}}', "is not a whole report"),
        ('{"settings": {}, "standing": {}, "rms_error": {}, "histograms": 3}', "is not a whole report"),
    ],
    ids=["missing", "text", "bytes", "list", "parts", "empty parts", "other parts"],
)
def test_no_report(tmp_path, content, message):
    """A file that is missing or no report is refused by its name, and nothing is drawn."""
    pytest.importorskip("matplotlib", reason="needs the extra: pip install -e .[plots]")
    file = tmp_path / "report.json"
    if content is not None:
        file.write_bytes(content.encode("latin1"))
    before = contents(tmp_path)
    result, _ = plot(file, tmp_path)
    assert_told_in_one_line(result, message)
    assert f"'{file}'" in result[2] and contents(tmp_path) == before


def test_without_matplotlib(made, tmp_path, monkeypatch):
    """The extra that is missing is named."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    result, picture = plot(made[2], tmp_path)
    assert_told_in_one_line(result, "pip install 'legged_torque[plots]'")
    assert not picture.exists()


def test_out_is_needed(made, tmp_path):
    """A picture without a name is a mistake."""
    assert_told_in_one_line(run_here("plot_pretraining.py", str(made[2]), root=tmp_path), "--out")


def test_unknown_format(made, tmp_path):
    """A picture of a format that nobody knows is refused in one line."""
    pytest.importorskip("matplotlib", reason="needs the extra: pip install -e .[plots]")
    words = [str(made[2]), f"--out={tmp_path / 'picture.xyz'}"]
    assert_told_in_one_line(run_here("plot_pretraining.py", *words, root=tmp_path), "cannot write")
