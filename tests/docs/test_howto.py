"""The code of the how-to pages and the README, run as it stands there; of ports, against the original's formulas."""

import math
import re
import runpy
import shlex
import shutil
import sys

import mujoco
import numpy as np
import pytest
import torch
import warp
from rsl_rl.algorithms import PPO
from support.documents import fences, make, python_files, train
from support.scripts import ROOT, command, run_here
from support.settings import parse

from legged_torque.envs import task_registry
from legged_torque.utils.cli import Parser
from legged_torque.utils.errors import UserError
from legged_torque.utils.options import Options

GENERATED = ("docs/reference/", "docs/results/", "docs/index.md", "docs/changelog.md", "docs/contributing.md")
FILES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md")] + sorted((ROOT / "docs").rglob("*.md"))
PAGES = [name for name in (str(file.relative_to(ROOT)) for file in FILES) if not name.startswith(GENERATED)]
RUN_PYTHON = {"README.md", "docs/terrain.md"} | {page for page in PAGES if page.startswith("docs/howto/")}
"""Pages whose Python is run: that of docs/terrain.md in tests/terrain/test_terrain.py, all else here."""
TINY = ["--device=cpu", "--num_envs=2", "--max_iterations=2", "--set=runner.num_steps_per_env=4"]
"""Options that make the trainings of a page short."""
YOURS = "yours"
"""Word in the mark of a block whose tasks and files a reader has made."""


@pytest.mark.parametrize(
    ("page", "name"),
    [
        ("README.md", "a1_quiet_torque"),
        ("docs/howto/reward.md", "a1_slow_joints"),
        ("docs/howto/reward.md", "a1_slow_joints_later"),
    ],
)
def test_reward(run_page, page, name):
    """The new term counts with its weight, which a curriculum changes from none to all."""
    run_page(page)
    task = make(name)
    assert "dof_vel" in task.reward_names
    task.dof_vel.copy_(torch.arange(48.0).view(4, 12))
    expected = np.square(np.arange(48.0).reshape(4, 12)).sum(axis=1)
    np.testing.assert_allclose(task._reward_dof_vel().numpy(), expected, rtol=1e-6)
    weights = dict(zip(task.reward_names, task.reward_weights().tolist(), strict=True))
    assert weights["dof_vel"] == pytest.approx(-1e-4 * 0.02 * (name != "a1_slow_joints_later"))
    assert ("torques" in task.reward_names) == (page == "README.md")
    if name == "a1_slow_joints_later":
        make("a1_foot_clearance").step(torch.zeros(4, 12))
        for steps, share in ((5_000_000, 0.5), (20_000_000, 1.0)):
            task.total_steps.fill_(steps)
            column = task.reward_names.index("dof_vel")
            assert task.reward_weights()[column].item() == pytest.approx(-1e-4 * 0.02 * share)


def test_commands_and_ends(run_page):
    """Commands lead forwards and weave; fast joints and a leaning trunk end an episode, and only those."""
    run_page("docs/howto/command.md")
    task = make("a1_weaving", num_envs=64)
    for _ in range(3):
        task.step(torch.zeros(64, 12))
        times = task.episode_length_buf.numpy() * 0.02
        np.testing.assert_allclose(task.commands[:, 2], 0.5 * np.sin(times * np.pi / 2.0), atol=1e-5)
    task = make("a1_careful", "init_state.pos=[0, 0, 5]")
    task.sim.qvel.zero_()
    task.sim.qvel[0, 8] = -31.0
    task.sim.qvel[1, 8] = -29.0
    angles = torch.tensor([0.0, 0.0, 0.95, 1.05])
    task.sim.qpos[:, 3:7] = torch.stack([torch.cos(angles / 2), torch.sin(angles / 2), 0 * angles, 0 * angles], dim=1)
    task.state.update()
    task.check_termination()
    assert task.reset_buf.tolist() == [True, False, False, True] and not task.time_out_buf.any()


def test_observation(run_page):
    """The new terms are seen, scaled, noisy for the policy only, mirrored, and sized everywhere."""
    run_page("docs/howto/observation.md")
    task = make("a1_feeling_torque", "noise.add_noise=true", num_envs=256)
    for _ in range(3):
        obs = task.step(torch.randn(256, 12))[0]
    assert obs["policy"].shape[1] == 57 and obs["critic"].shape[1] == 45 + 12 + 8 + 117 + 1
    columns = task.observations.policy_columns("torque")
    assert columns == list(range(45, 57))
    torch.testing.assert_close(obs["critic"][:, columns], 0.03 * task.torques)
    error = (obs["policy"] - obs["critic"][:, :57])[:, columns].abs() / 0.03
    assert 0.45 < error.max() <= 0.5 + 1e-4
    torch.testing.assert_close(obs["critic"][:, -1], task.feet_air_time.mean(dim=1))
    mirrored = task.mirror("policy", obs["policy"])[:, columns].view(-1, 4, 3)
    swapped = obs["policy"][:, columns].view(-1, 4, 3)[:, [1, 0, 3, 2]] * torch.tensor([-1.0, 1.0, 1.0])
    assert torch.equal(mirrored, swapped)
    train(make("a1_feeling_torque"), "a1_feeling_torque")


def test_parameter(run_page):
    """The masses are drawn from their range, one factor for all thighs, which the critic sees."""
    run_page("docs/howto/parameter.md")
    task = make("a1_thigh_mass", "domain_rand.randomize_parameters=true", num_envs=64)
    model = task.sim.mj_model
    thighs = [model.body(f"{leg}_thigh").id for leg in ("FR", "FL", "RR", "RL")]
    ratio = task.sim.field("body_mass")[:, thighs] / torch.tensor(model.body_mass[thighs], dtype=torch.float32)
    assert (ratio.amax(dim=1) - ratio.amin(dim=1)).max() < 1e-6
    assert ratio.min() > 0.8 and ratio.max() < 1.2 and ratio.std() > 0.08
    critic = task.get_observations()["critic"]
    torch.testing.assert_close(critic[:, -1], (ratio[:, 0] - 1.0) / 0.2, atol=1e-4, rtol=0)
    train(make("a1_thigh_mass", "domain_rand.randomize_parameters=true"), "a1_thigh_mass")


def test_learner(tmp_path, monkeypatch):
    """The page's learner trains in one process where there are two cores, resumes and is evaluated by the scripts."""
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    file = tmp_path / "random_search.py"
    file.write_text(python_files("docs/howto/learner.md")[0][1])
    monkeypatch.setattr(task_registry, "_tasks", dict(task_registry._tasks))
    words = ["--task=a1_search", f"--task_file={file}", "--device=cpu"]
    settings = [*TINY, "--logger=none", "--set=actor.hidden_dims=[8]", "--set=evaluation.interval=8"]
    for more in ([*settings, "--set=evaluation.num_samples=4"], ["--resume", "--max_iterations=3"]):
        status, output, error = run_here("train.py", *words, *more, root=tmp_path)
        assert (status, error) == (0, "") and "anew" not in output
    (file,) = tmp_path.glob("logs/a1_search/*/model_3.pt")
    assert torch.load(file, weights_only=True)["best_reward"] > -math.inf
    assert run_here("evaluate.py", *words, "--num_envs=2", "--steps=2", root=tmp_path)[0] == 0


def test_approach(run_page):
    """Each approach of the page gives its torques; with a Warp function they come from the kernel alone."""
    run_page("docs/howto/approach.md")
    task, actions = make("a1_curriculum_multihead"), torch.randn(4, 24)
    assert task.num_actions == 24 and "nominal_position" in task.reward_names
    pd = 20.0 * (task.default_dof_pos + 0.25 * actions[:, :12] - task.dof_pos) - 0.5 * task.dof_vel
    task.total_steps.fill_(32_000_000)
    task.update_curriculum()
    torch.testing.assert_close(task._compute_torques(actions), 0.36 * pd + 4.0 * actions[:, 12:])
    train(make("a1_curriculum_multihead"), "a1_curriculum_multihead")
    tasks = [make(name, "init_state.pos=[0, 0, 50]") for name in ("a1_velocity", "a1_fast_velocity")]
    actions = torch.randn(4, 12)
    torch.testing.assert_close(tasks[0]._compute_torques(actions), 2.0 * (10.0 * actions - tasks[0].dof_vel))
    tasks[1].motors.apply = None  # which torch would need
    for _ in range(4):
        for task in tasks:
            task.step(actions)
    assert tasks[0].torques.abs().max() > 5.0
    torch.testing.assert_close(tasks[1].torques, tasks[0].torques, rtol=1e-3, atol=1e-3)
    train(make("a1_velocity"), "a1_velocity")


def test_motor(run_page):
    """The lag is drawn; the rate limit acts in the kernel: 1.5 N m per physics step; a network is TorchScript's."""
    words = next(words for *_, words in calls_of("docs/howto/motor.md") if "motors.lag.draws" in str(words))
    drawing, _ = task_registry.make_env("a1_torque", parse(*words, "--num_envs=4"))
    lags = drawing.motors.links["lag"].values.time_constant
    assert 0.001 <= lags.min() < lags.max() <= 0.003
    names, network = run_page("docs/howto/motor.md"), torch.nn.Sequential(torch.nn.Linear(6, 8), torch.nn.Softsign())
    network.append(torch.nn.Linear(8, 1))
    torch.jit.script(network).save("net.pt")
    names["convert"]("net.pt", "net.json", "softsign")
    chain = ["motors.chain=[network]", "motors.network.file=net.json", "motors.network.velocity_scale=0.1"]
    driven = make("a1_position", "init_state.pos=[0, 0, 50]", "control.decimation=1", *chain)
    error, vel = driven.default_dof_pos - driven.dof_pos, 0.1 * driven.dof_vel
    driven.step(torch.zeros(4, 12))
    past = torch.zeros(4, 12, 2)
    expected = network(torch.cat([error[..., None], past, vel[..., None], past], dim=2))
    torch.testing.assert_close(driven.torques, expected[..., 0].detach(), rtol=1e-4, atol=1e-4)
    task = make("a1_slew", "init_state.pos=[0, 0, 50]")
    assert not task.notes
    task.step(torch.full((4, 12), 2.0))
    torch.testing.assert_close(task.torques, torch.full((4, 12), 6.0))
    train(task, "a1_slew")


def test_sensor(run_page):
    """Rays are as long as the trunk is high, two control steps late."""
    run_page("docs/howto/observation.md")
    task = make("a1_ray")
    heights = []
    for _ in range(6):
        heights.append(task.base_pos[:, 2].clone())
        obs = task.step(torch.zeros(4, 12))[0]
    seen = obs["policy"][:, -2:]
    assert (seen == seen[:, :1]).all() and not torch.equal(seen[:, 0], task.base_pos[:, 2])
    assert any(torch.allclose(seen[:, 0], height) for height in heights)


def test_robot(run_page, monkeypatch):
    """The page's robot stands under PD control and can be trained."""
    monkeypatch.setattr(warp.config, "optimization_level", 0)  # few steps with a kernel that no other test needs
    shutil.copy(ROOT / "examples" / "minidog.xml", "minidog.xml")
    run_page("docs/howto/robot.md")
    task = make("minidog_position")
    assert task.num_dof == 8 and task.foot_names == ["FR_foot", "FL_foot", "RR_foot", "RL_foot"]
    assert task.p_gains[0].tolist() == [15.0, 10.0] * 4
    for _ in range(100):
        task.step(torch.zeros(4, 8))
    assert not task.num_diverged and (task.episode_length_buf == 100).all()
    assert (task.base_pos[:, 2] > 0.2).all() and (task.feet_contact.sum(dim=1) > 2).all()
    assert make("minidog_torque").num_actions == 8  # trained is the other task, whose kernels are there
    train(task, "minidog_position")


def script_calls(block):
    """(script, words) of each call of a script in a Bash block, also behind ``&&`` and ``torchrun``."""
    for name, value in re.findall(r"^for (\w+) in (\S+)", block, flags=re.MULTILINE):
        block = block.replace(f"${name}", value)
    lines = re.split(r"\n|&&", block.replace("\\\n", " "))
    calls = []
    for words in (shlex.split(line, comments=True) for line in lines if "$(" not in line):
        for place, word in enumerate(words):
            if re.match(r"scripts/\w+\.py$", word):
                calls.append((word.removeprefix("scripts/"), words[place + 1 :]))
        if words[:1] == ["legged-torque"]:
            calls.append((f"{words[1]}.py", words[2:]) if words[1:] else ("", []))
    return calls


def calls_of(page):
    """(mark, script, words) of each call of a page, in its Bash blocks and as code within sentences."""
    calls = [
        (mark, *call) for _, mark, language, block in fences(page) if language == "bash" for call in script_calls(block)
    ]
    prose = re.sub(r"^```.*?^```", "", (ROOT / page).read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    for code in re.findall(r"`((?:legged-torque|python\s+scripts/|\w+\.py)\s[^`]*)`", prose):
        code = re.sub(r"^(\w+\.py)", r"scripts/\1", " ".join(code.split()))
        calls += [(YOURS, *call) for call in script_calls(code) if not call[1] or not call[1][-1].startswith("--")]
    return calls


def test_python(run_page):
    """The page makes a task, trains it, loads the run, rolls it out and measures it."""
    names = run_page("docs/howto/python.md")
    assert names["heights"][0].shape == (4,) and names["pair"].num_envs == 2
    assert 0.0 <= names["metrics"].means()["track_percentage"] <= 1.0
    task = make("a1_decap", "control.decap.record=walk.csv")
    task.step(torch.zeros(4, 12))
    np.testing.assert_allclose(task.reference[0], names["angles"][0], rtol=1e-6)


@pytest.mark.parametrize("page", PAGES)
def test_commands(page, tmp_path, monkeypatch):
    """Bash that is not marked is run, in its order, trainings with few worlds; so it calls nothing but scripts."""
    monkeypatch.setattr(task_registry, "_tasks", dict(task_registry._tasks))
    for folder in ("experiments", "examples"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    for line, mark, language, block in fences(page):
        if language == "bash" and not mark:
            calls = script_calls(block)
            lines = block.replace("\\\n", " ").strip().splitlines()
            assert len(calls) == len(lines), f"{page}:{line}"
            for script, words in calls:
                held = ["--set=control.refresh_torques=false"] if "motor" in page else []  # with a shared kernel
                is_training = script == "train.py" and not {"--list", "--help"} & set(words)
                if script:
                    result = run_here(script, *words, *([*TINY, *held] if is_training else []), root=tmp_path)
                else:
                    result = command()
                assert (result[0], result[2]) == (0, "") and result[1], [script, *words]


@pytest.mark.parametrize("page", PAGES)
def test_options_of_commands(page, monkeypatch, tmp_path):
    """Each call of a script, marked or not, has these options, tasks, settings and files; it ends once parsed."""
    parse = Parser.parse_args

    def parse_only(parser, *words):
        args = parse(parser, *words)
        is_yours = YOURS in calls[len(parsed)][0] or getattr(args, "task_file", [])
        task = getattr(args, "task", "") or Options().task
        if getattr(args, "set", None) is not None and (task in task_registry.names() or not is_yours):
            named = {name: getattr(args, name, None) for name in ("preset", "perturbation", "ranges")}
            task_registry.get_cfgs(task, Options(set=args.set, **named))
        parsed.append(args)
        raise SystemExit(0)

    parsed = []
    monkeypatch.setattr(Parser, "parse_args", parse_only)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MUJOCO_GL", "disable")
    calls = [call for call in calls_of(page) if call[1] and "--help" not in call[2]]
    for _, script, words in calls:
        files = [word for word in words if re.match(r"experiments/\w+\.yaml$", word)]
        assert all((ROOT / file).is_file() for file in files), files
        monkeypatch.setattr(sys, "argv", [script, *words])
        with pytest.raises(SystemExit) as stop:
            runpy.run_path(str(ROOT / "scripts" / script), run_name="__main__")
        assert stop.value.code == 0, [script, *words]
    assert len(parsed) == len(calls)


def test_legged_gym(run_page):
    """The policy sees the height that the reward asks for; commands are those of the original, in chosen worlds."""
    run_page("docs/howto/from_legged_gym.md")
    task = make("a1_crouching", "commands.resampling_probability=0", num_envs=64)
    height = task.get_observations()["policy"][:, -1] / 5.0
    for _ in range(3):
        obs, _, dones, _ = task.step(torch.randn(64, 12))
        assert not dones.any()
        term = task.rewards.terms[task.reward_names.index("height")]
        torch.testing.assert_close(term, -20.0 * 0.02 * (task.sim.qpos[:, 2] - height) ** 2)
        torch.testing.assert_close(obs["policy"][:, -1] / 5.0, height)
    assert "base_height" not in task.reward_names and task.observations.policy_columns("height_command") == [45]
    drawn = []
    for _ in range(100):
        task.command_generator.resample(torch.ones(64, dtype=torch.bool))
        task.compute_observations()
        drawn.append(torch.cat([task.commands, task.obs_buf["policy"][:, -1:] / 5.0], dim=1))
    low, high = torch.cat(drawn).aminmax(dim=0)
    torch.testing.assert_close(low, torch.tensor([0.3, 0.0, -1.0, 0.2]), atol=0.01, rtol=0)
    torch.testing.assert_close(high, torch.tensor([1.0, 0.0, 1.0, 0.3]), atol=0.01, rtol=0)
    assert low[0] >= 0.3 and low[3] >= 0.2 - 1e-6 and high[0] <= 1.0 and high[3] <= 0.3 + 1e-6
    before = drawn[-1]
    seen = task.reset(3)["policy"][:, -1] / 5.0
    is_new = torch.arange(64) == 3
    assert torch.equal((seen - before[:, 3]).abs() > 1e-6, is_new)
    assert torch.equal((task.commands != before[:, :3]).any(dim=1), is_new)
    assert "height_command" in task.world_state_dict()["task"]
    train(make("a1_crouching"), "a1_crouching")


def test_mjlab(run_page):
    """Power and foot heights are those of MuJoCo; the masses of calves are drawn one by one, at resets alone."""
    run_page("docs/howto/from_mjlab.md")
    task = make("go1_ported", "domain_rand.keep_fixed=[foot_pos]", num_envs=64)
    model, names = task.sim.mj_model, ("FR", "FL", "RR", "RL")
    data, feet = mujoco.MjData(model), [model.geom(f"{name}_foot").id for name in names]
    calves = [model.body(f"{name}_calf").id for name in names]
    masses = task.sim.field("body_mass")[:, calves].clone()
    for _ in range(3):
        obs, rewards, dones, _ = task.step(torch.randn(64, 12))
        assert not dones.any()
        power, height = np.zeros(64), np.zeros((64, 4))
        for world, (qpos, qvel, ctrl) in enumerate(zip(task.sim.qpos, task.sim.qvel, task.sim.ctrl, strict=True)):
            data.qpos, data.qvel, data.ctrl = qpos, qvel, ctrl
            mujoco.mj_forward(model, data)
            moved = [model.joint(f"{name}_calf_joint").dofadr[0] for name in names]
            power[world] = np.abs(data.qfrc_actuator[moved] * data.qvel[moved]).sum()
            height[world] = data.geom_xpos[feet, 2]
        term = task.rewards.terms[task.reward_names.index("calf_power")]
        np.testing.assert_allclose(term, -1e-3 * 0.02 * power, rtol=1e-4, atol=1e-7)
        np.testing.assert_allclose(rewards, task.rewards.terms.sum(dim=0), rtol=1e-4, atol=1e-6)
        assert (rewards < 0.0).any()
        columns = task.observations.policy_columns("foot_height")
        np.testing.assert_allclose(obs["critic"][:, columns], 5.0 * height, atol=1e-4)
        mirrored = task.mirror("policy", obs["policy"])[:, columns]
        assert torch.equal(mirrored, obs["policy"][:, columns][:, [1, 0, 3, 2]])
        assert 0.08 < (obs["policy"] - obs["critic"][:, :49])[:, columns].abs().max() <= 5.0 * 0.02 + 1e-5
    assert torch.equal(task.sim.field("body_mass")[:, calves], masses)
    ratio = masses / torch.tensor(model.body_mass[calves], dtype=torch.float32)
    assert ratio.min() >= 0.8 - 1e-6 and ratio.max() <= 1.2 + 1e-6 and ratio.std(dim=0).min() > 0.08
    assert torch.corrcoef(ratio.T).triu(diagonal=1).abs().max() < 0.4
    task.reset(3)
    is_new = (task.sim.field("body_mass")[:, calves] != masses).any(dim=1)
    assert torch.equal(is_new, torch.arange(64) == 3)
    train(make("go1_ported"), "go1_ported")


def test_rsl_rl(run_page, tmp_path):
    """rsl_rl's own runner and PPO train the page's task; it loads checkpoints of this library, which refuses its."""
    theirs = run_page("docs/howto/from_rsl_rl.md")["runner"]
    assert type(theirs.alg) is PPO and theirs.env.total_steps == 2 * 24 * 4
    ours, _ = task_registry.make_alg_runner(theirs.env, "a1_torque", Options(device="cpu"), log_root=None)
    ours.save(str(tmp_path / "ours.pt"))
    assert not torch.equal(theirs.alg.actor.mlp[0].weight, ours.alg.actor.mlp[0].weight)
    theirs.load(str(tmp_path / "ours.pt"))
    assert torch.equal(theirs.alg.actor.mlp[0].weight, ours.alg.actor.mlp[0].weight)
    with pytest.raises(UserError, match="lacks the entry infos"):
        ours.load(str(tmp_path / "logs" / "own" / "model_1.pt"))
