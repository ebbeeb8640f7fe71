"""``pretrain_gravity.py --check_standing``, and ``plot.py``."""

import re
import sys

import matplotlib.image
import torch
from support.gravity import TASK
from support.reports import line, write_run
from support.scripts import ROOT, assert_told_in_one_line, contents, run_here

CHECK = ["--device=cpu", "--num_envs=8", "--check_standing"]


def test_standing(made, tmp_path):
    """The controller stands nearly always, at 200 Hz or at 50 Hz; a policy of constant torques (4 N m) never does."""
    root, file, *_ = made
    content = torch.load(file, weights_only=True)
    *_, weight, bias = (name for name in content["actor_state_dict"] if name.startswith("mlp."))
    content["actor_state_dict"][weight][:] = 0.0
    content["actor_state_dict"][bias][:] = 0.5
    changed = tmp_path / "changed.pt"
    torch.save(content, changed)
    before = contents(root)
    status, output, error = run_here("pretrain_gravity.py", *CHECK, f"--set=pretraining.file={changed}", root=root)
    assert (status, error) == (0, "") and contents(root) == before
    head, *rows = output.splitlines()
    assert head.split() == ["frequency", "after", "standing", "mean", "torque"]
    pattern = r"(controller|policy) +(\d+) Hz +(\d) s +([\d.]+)% +([\d.]+) N m"
    rows = [re.fullmatch(pattern, row).groups() for row in rows]
    assert [row[:3] for row in rows] == [("controller", "200", "3"), ("controller", "50", "5"), ("policy", "50", "5")]
    for *_, share, torque in rows[:2]:
        assert 93.0 < float(share) <= 100.0 and 1.0 < float(torque) < 8.0
    assert rows[2][3:] == ("0.0", "4.00")


def test_standing_refuses(made, tmp_path):
    """A policy that is missing or does not fit is named, and so is an option that makes one; nothing is written."""
    result = run_here("pretrain_gravity.py", *CHECK, root=tmp_path)
    message = (
        f"no pre-trained policy 'logs/pretrained/{TASK}.pt'; make it first: python {ROOT}/scripts/pretrain_gravity"
    )
    assert_told_in_one_line(result, message)
    assert result[1] == "" and not list(tmp_path.iterdir())
    result = run_here("pretrain_gravity.py", *CHECK, "--set=control.torque_scale=5", root=made[0])
    assert_told_in_one_line(result, "its control.torque_scale is 8.0, here it is 5.0")
    result = run_here("pretrain_gravity.py", *CHECK, "--num_steps=5", root=made[0])
    assert_told_in_one_line(result, "--num_steps is for making a policy, which --check_standing does not do")
    result = run_here("pretrain_gravity.py", *CHECK, "--set=pretraining.controller.joint_damping=5", root=made[0])
    assert_told_in_one_line(result, "pretraining.controller is for making a policy")
    result = run_here("pretrain_gravity.py", *CHECK, "--perturbation=high", root=made[0])
    assert_told_in_one_line(result, "unknown option '--perturbation'")


def plot(figure, file, folder, name="picture.png"):
    """Draw a figure of a file; return the result and the picture's path, in a folder that is not there yet."""
    picture = folder / "new" / name
    return run_here("plot.py", figure, str(file), f"--out={picture}", root=folder), picture


def test_pretraining(made, tmp_path):
    """It is an image of four panels in a row."""
    result, picture = plot("pretraining", made[0] / "report.json", tmp_path)
    assert result == (0, "", "")
    height, width, _ = matplotlib.image.imread(picture).shape
    assert 1500 < width < 3000 and 3.0 < width / height < 6.0


def test_randomization(tmp_path):
    """It is an image that can be read, of what is drawn and what is not."""
    picture = tmp_path / "new" / "picture.png"
    words = ["--task=a1_torque_multihead", "--perturbation=doubled", "--device=cpu", "--num_envs=12"]
    words += [f"--out={picture}", "--set=motors.delay.range=[1, 4]", "--set=domain_rand.keep_fixed=[gravity]"]
    assert run_here("plot.py", "randomization", *words, root=tmp_path) == (0, "", "")
    height, width, _ = matplotlib.image.imread(picture).shape
    assert 1000 < width < 2500 and 1000 < height < 2500


def test_curves(tmp_path):
    """Several files go into one figure."""
    for seed in (3, 4):
        config = {"task": "a1_torque", "env": {}, "train": {"seed": seed}, "versions": {}}
        write_run(tmp_path / str(seed), [line(1, 0.1), line(2, 0.2)], config)
    files = [str(tmp_path / seed / "evaluations.csv") for seed in ("3", "4")]
    picture = tmp_path / "new" / "curves.svg"
    assert run_here("plot.py", "curves", *files, f"--out={picture}", root=tmp_path) == (0, "", "")
    text = picture.read_text()
    assert all(f"<!-- {name} -->" in text for name in ("Default torque, seed 3", "Default torque, seed 4"))
    assert "<!-- Cost of transport -->" in text


def test_mistakes(made, tmp_path, monkeypatch):
    """A figure that does not exist, a missing option, an unknown format, and a missing extra are named."""
    report = made[0] / "report.json"
    result = run_here("plot.py", "curve", root=tmp_path)
    assert_told_in_one_line(result, "unknown figure 'curve'; did you mean 'curves'?")
    assert_told_in_one_line(run_here("plot.py", "pretraining", str(report), root=tmp_path), "--out")
    assert_told_in_one_line(plot("pretraining", report, tmp_path, "picture.xyz")[0], "cannot write")
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for words in (("pretraining", str(report)), ("curves", str(report)), ("randomization", "--device=cpu")):
        result = run_here("plot.py", *words, "--out=picture.png", root=tmp_path)
        assert_told_in_one_line(result, "pip install 'legged_torque[plots]'")
    assert not list(tmp_path.iterdir())
