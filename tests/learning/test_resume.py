"""A resumed training gives the same bits as one that never stopped, or says in a line why its worlds start anew."""

import os
import re
import shutil
import threading
from pathlib import Path

import pytest
import torch
from support.reproducible import differences, values
from support.settings import error_of, parse

from legged_torque.envs import task_registry
from legged_torque.learning import checkpoint
from legged_torque.utils.config import to_dict
from legged_torque.utils.task_registry import set_seed

WORLDS = 6
WORDS = ["--task=a1_torque_multihead", f"--num_envs={WORLDS}", "--perturbation=low", "--logger=none", "--seed=3"]
WORDS += ["--set=runner.num_steps_per_env=4", "--set=algorithm.num_mini_batches=2", "--set=runner.save_interval=1"]
WORDS += ["--set=actor.hidden_dims=[8, 8]", "--set=actor.head_hidden_dims=[8]", "--set=critic.hidden_dims=[8]"]
WORDS += ["--set=evaluation.interval=24", "--set=evaluation.num_samples=60", "--set=env.episode_length_s=0.2"]
WORDS += ["--set=evaluation.also=[high]", "--set=evaluation.also_from=48"]
WORDS += ["--set=env.history_length=2", "--set=motors.delay.range=[0, 3]"]
WORDS += ["--set=motors.delay.jitter=5", "--set=motors.delay.loss=0.2"]
WORDS += ["--set=sensing.delay.range=[0, 3]", "--set=sensing.delay.jitter=2", "--set=sensing.delay.loss=0.2"]


def start(root, *words):
    """The runner that train.py would build, in a folder of runs ``root``."""
    options = parse(*WORDS, *words)
    if options.resume:
        run = task_registry.load_run(options)
        env_cfg, train_cfg, options.load_run = run.env_cfg, run.train_cfg, str(run.folder)
    else:
        env_cfg, train_cfg = task_registry.get_cfgs(options.task, options)
    set_seed(train_cfg.seed)
    env, _ = task_registry.make_env(options.task, options, env_cfg)
    runner, _ = task_registry.make_alg_runner(env, options.task, options, train_cfg, root)
    return runner


def begin(root, *words):
    """The runner of a new run."""
    runner = start(root, *words)
    options = parse(*WORDS, *words)
    env_cfg, train_cfg = map(to_dict, task_registry.get_cfgs(options.task, options))
    runner.claim_log_dir({"task": options.task, "env": env_cfg, "train": train_cfg})
    return runner


def train(root, iterations, *words):
    """Train from the start, and return the runner."""
    runner = begin(root, *words)
    runner.learn(iterations, init_at_random_ep_len=True)
    return runner


def content(runner, iterations):
    """The contents of a run's checkpoint by name, without times."""
    file = Path(runner.log_dir) / f"model_{iterations}.pt"
    return dict(values(torch.load(file, weights_only=True)))


def upcoming():
    """The next numbers of the stream, which stays where it is."""
    state = torch.get_rng_state()
    numbers = torch.rand(5)
    torch.set_rng_state(state)
    return numbers


def without_seconds(lines):
    """The cells of a table, apart from times."""
    column = lines[0].split(",").index("seconds")
    return [[cell for i, cell in enumerate(line.split(",")) if i != column] for line in lines]


@pytest.fixture(scope="module")
def half(tmp_path_factory):
    """A run of two iterations, whose folder stays as it is."""
    return train(tmp_path_factory.mktemp("half"), 2)


@pytest.fixture
def copied(half, tmp_path):
    """A copy of the folder of the run of two iterations."""
    return Path(shutil.copytree(half.log_dir, tmp_path / "run"))


def go_on(half, folder, whole, *words):
    """Resume a run of two iterations; return the runner after two more, with the bits of a run of four."""
    resumed = start(folder, *words, "--resume", f"--load_run={half.log_dir}")
    resumed.claim_log_dir({})
    resumed.learn(2, init_at_random_ep_len=True)
    first, second = content(whole, 4), content(resumed, 4)
    assert len(first) > 100 and first["infos.worlds"] and not differences(first, second)
    return resumed


def test_two_and_two_are_four(half, tmp_path):
    """Networks, moments, random numbers, worlds and evaluations are the same bits."""
    whole = train(tmp_path / "whole", 4)
    resumed = go_on(half, tmp_path / "resumed", whole)
    for name, count in {"evaluations.csv": 4, "evaluations_high.csv": 3}.items():
        rows = [(Path(runner.log_dir) / name).read_text().splitlines() for runner in (whole, half, resumed)]
        assert len(rows[0]) == count + 1  # with the header
        assert without_seconds(rows[0]) == without_seconds(rows[1] + rows[2][1:])


OTHERS = {
    "mujoco_warp": ["--set=sim.engine=mujoco_warp", "--set=evaluation.interval=0"],
    "hard": ["--ranges=hard", "--set=domain_rand.push_probability=0.5", "--set=domain_rand.resampling_probability=0.5"],
    "rough": ["--task=a1_rough_torque_multihead_scan", "--set=terrain.num_rows=3"],
}
OTHERS["two rates"] = ["--task=a1_multihead_two_rates", "--set=runner.num_steps_per_env=3"]  # ends within intervals
OTHERS["two rates"] += ["--set=env.history_length=1", "--set=evaluation.interval=0"]
OTHERS["hard"] += ["--set=evaluation.interval=1000"]  # evaluated at the ends
OTHERS["rough"] += ["--set=terrain.max_init_terrain_level=2", "--set=terrain.border_size=1", OTHERS["hard"][-1]]
OTHERS["rough"] += ["--set=motors.delay.unit=control_steps", "--set=control.refresh_torques=false"]  # a shared kernel


@pytest.mark.parametrize("name", OTHERS)
def test_two_and_two_are_four_elsewhere(tmp_path, name):
    """The other engine, ranges that change everything often, held actions and a map with levels keep nothing else."""
    words = OTHERS[name]
    whole, half = (train(tmp_path / folder, count, *words) for folder, count in (("whole", 4), ("half", 2)))
    go_on(half, tmp_path / "resumed", whole, *words)


@pytest.mark.parametrize("ends_at", ["worlds_3.pt", "model_3.pt"])
def test_an_end_between_worlds_and_checkpoint(tmp_path, monkeypatch, ends_at):
    """Whichever of both cannot be written any more, the last checkpoint has its worlds."""
    write = checkpoint.write

    def write_or_end(file, state):
        if file.name == ends_at:
            raise KeyboardInterrupt
        return write(file, state)

    runner = train(tmp_path, 2, "--set=evaluation.interval=0")
    before = {name: value.clone() for name, value in values(runner.env.world_state_dict())}
    monkeypatch.setattr(checkpoint, "write", write_or_end)
    with pytest.raises(KeyboardInterrupt):
        runner.learn(1)
    monkeypatch.undo()
    resumed = start(tmp_path, "--resume", f"--load_run={runner.log_dir}")
    assert resumed.current_learning_iteration == 2
    assert not differences(before, dict(values(resumed.env.world_state_dict())))


def test_random_numbers_go_on(tmp_path):
    """A resumed run takes those that came after the checkpoint was saved; loading alone keeps those of the seed."""
    run = train(tmp_path, 1)
    after = upcoming()
    runner = start(None)
    first = upcoming()
    runner.load(f"{run.log_dir}/model_1.pt")
    assert torch.equal(upcoming(), first) and not torch.isclose(first, after).any()
    start(None, "--resume", f"--load_run={run.log_dir}")
    assert torch.equal(upcoming(), after)


@pytest.mark.parametrize("states", [None, [{"cpu": torch.zeros(3, dtype=torch.uint8)}]])
def test_a_checkpoint_without_usable_states(copied, states):
    """Resuming without the random numbers of the run is refused in one line."""
    state = torch.load(copied / "model_2.pt", weights_only=True)
    state["infos"]["random_states"] = states
    torch.save(state, copied / "model_2.pt")
    assert "random_states" in error_of(start, None, "--resume", f"--load_run={copied}")


def damage(file):
    """Flip bits all over the middle of a file, some of which are data and not filling."""
    data = bytearray(file.read_bytes())
    for place in range(len(data) // 3, len(data) // 2, 50):
        data[place] ^= 4
    file.write_bytes(data)


def other_processes(run):
    """Make the run one of two processes."""
    worlds = torch.load(run / "worlds_2.pt", weights_only=True)
    state = torch.load(run / "model_2.pt", weights_only=True)
    state["infos"]["worlds"] = checkpoint.write(run / "worlds_2.pt", {**worlds, "processes": worlds["processes"] * 2})
    torch.save(state, run / "model_2.pt")


HIGH = "--set=evaluation.perturbation=high"
ANEW = {
    "another number": (other_processes, [], "2 processes have trained, now there are 1."),
    "another setting": (lambda run: None, ["--set=control.stiffness=21"], "control.stiffness is 21.0, was 20.0"),
    "evaluated elsewhere": (lambda run: None, [HIGH], "evaluation.perturbation is high"),
    "an older one": (lambda run: None, ["--checkpoint=1"], "only the last checkpoint of a run keeps them"),
    "missing": (lambda run: (run / "worlds_2.pt").unlink(), [], "there is no '"),
    "damaged": (lambda run: damage(run / "worlds_2.pt"), [], "is damaged or belongs to another checkpoint"),
}


@pytest.mark.parametrize("case", ANEW)
def test_worlds_start_anew(copied, tmp_path, capsys, case):
    """One line says why, and training goes on with the networks."""
    change, words, message = ANEW[case]
    change(copied)
    capsys.readouterr()
    runner = start(None, *words, "--resume", f"--load_run={copied}")
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "anew" in line]
    assert line.startswith("The worlds start anew: ") and message in line
    assert int(runner.env.episode_length_buf.max()) == 0
    runner.learn(1, init_at_random_ep_len=True)
    assert runner.current_learning_iteration == (2 if case == "an older one" else 3)


@pytest.mark.parametrize("how", [damage, lambda file: file.write_bytes(file.read_bytes()[:-9]), Path.unlink])
def test_a_damaged_checkpoint_is_passed_over(copied, capsys, how):
    """Training goes on from the one before, and a line says so; asked for by number, it is refused."""
    how(copied / "model_2.pt")
    runner = start(None, "--resume", f"--load_run={copied}")
    output = capsys.readouterr().out
    assert runner.current_learning_iteration == 1
    assert ("Newer checkpoints than" in output) == (how is not Path.unlink)
    if how is not Path.unlink:
        words = ["--resume", f"--load_run={copied}", "--checkpoint=2"]
        assert "model_2.pt' is not a readable checkpoint" in error_of(start, None, *words)


BAD = {
    "actor_state_dict": lambda state: next(iter(state["actor_state_dict"].values())).fill_(torch.nan),
    "optimizer_state_dict": lambda state: state["optimizer_state_dict"]["state"][3]["exp_avg_sq"].fill_(torch.inf),
    "lr": lambda state: state["optimizer_state_dict"]["param_groups"][0]["lr"].fill_(torch.nan),
    "seconds": lambda state: state["infos"].__setitem__("seconds", float("nan")),
    "total_timesteps": lambda state: state["infos"].__setitem__("total_timesteps", -5),
}


@pytest.mark.parametrize("name", BAD)
def test_numbers_that_are_none(copied, name):
    """A checkpoint with one is refused by the name of what holds it, whatever it is loaded for."""
    state = torch.load(copied / "model_2.pt", weights_only=True)
    BAD[name](state)
    torch.save(state, copied / "model_2.pt")
    runner = start(None)
    before = {key: value.clone() for key, value in runner.alg.actor.state_dict().items()}
    line = error_of(runner.load, str(copied / "model_2.pt"))
    assert "model_2.pt' is not a usable checkpoint" in line and name in line
    assert not differences(before, runner.alg.actor.state_dict())


def test_a_damaged_run_is_passed_over(half, tmp_path, capsys):
    """If the newest run has nothing but damaged checkpoints, the one before is taken, and a line says so."""
    runs = [shutil.copytree(half.log_dir, tmp_path / "a1_torque_multihead" / f"2026-01-0{day}") for day in (1, 2)]
    for file in runs[1].glob("*.pt"):
        file.write_bytes(b"")
    runner = start(None, "--resume", f"--log_root={tmp_path}")
    assert f"Newer checkpoints than '{runs[0] / 'model_2.pt'}' are damaged" in capsys.readouterr().out
    assert runner.current_learning_iteration == 2


def test_what_killed_processes_have_left_is_removed(copied):
    """Those of processes that run, or may run on another machine, are not touched."""
    host = os.uname().nodename
    dead, *others = (copied / f"model_3.pt.{of}.part" for of in (f"{host}.999999999", f"{host}.1", "other.999999999"))
    for file in (dead, *others):
        file.touch()
    start(None, "--resume", f"--load_run={copied}")
    assert not dead.exists() and all(file.exists() for file in others)


def test_a_checkpoint_is_of_its_iteration(tmp_path, monkeypatch):
    """While its files are written, training goes on; they have what there was before."""
    runner, gone_on, noted, kept = begin(tmp_path), threading.Event(), {}, {}
    runner.cfg["save_interval"] = 1
    write, collect = checkpoint.write, runner.collect_rollout

    def write_late(file, state):
        if file.name in ("worlds_1.pt", "model_1.pt"):
            assert gone_on.wait(60.0)
            kept.update({name: value.clone() for name, value in values(state) if isinstance(value, torch.Tensor)})
        return write(file, state)

    def collect_and_note():
        if runner.current_learning_iteration == 1:
            state = {"processes": [{"worlds": runner.env.world_state_dict()}]}
            state["actor_state_dict"] = runner.alg.actor.state_dict()
            noted.update({name: value.clone() for name, value in values(state)})
        collect()
        if runner.current_learning_iteration == 1:
            gone_on.set()

    monkeypatch.setattr(checkpoint, "write", write_late)
    runner.collect_rollout = collect_and_note
    runner.learn(3)
    after = dict(values({"processes": [{"worlds": runner.env.world_state_dict()}]}))
    assert len(noted) > 30 and not differences(noted, {name: kept[name] for name in noted})
    assert differences({name: noted[name] for name in after}, after)


def test_files_that_cannot_be_written(tmp_path, capsys):
    """Training goes on without curves, evaluations and worlds; a line each says so. Without checkpoints it ends."""

    class Writer:
        """Fails from the first number on."""

        def add_scalar(self, *_):
            raise OSError(28, "No space left on device")

    runner = begin(tmp_path)
    folder = Path(runner.log_dir)
    runner.logger.init_logging_writer = lambda: setattr(runner.logger, "writer", Writer())
    (folder / "evaluations.csv").mkdir()
    runner.learn(1)
    (folder / "worlds_2.pt").mkdir()
    runner.learn(1)
    output, error = capsys.readouterr()
    parts = ("logs end here", "an evaluation is not kept: cannot write '", "worlds would start anew in a resumed run")
    assert all(f"Warning: {part}" in error for part in parts)
    assert re.findall(r"iteration (\d) of 2", output)[-1] == "2" and runner.logger.tot_timesteps == 2 * 4 * WORLDS
    files = {path.name for path in folder.glob("*.pt*") if path.is_file()}
    assert files == {"model_0.pt", "model_1.pt", "worlds_1.pt", "model_2.pt"}  # the last worlds stay with theirs
    start(None, "--resume", f"--load_run={runner.log_dir}")
    assert "The worlds start anew" in capsys.readouterr().out
    (folder / "model_3.pt").mkdir()
    runner.cfg["save_interval"] = 1
    assert f"cannot write '{folder / 'model_3.pt'}" in error_of(runner.learn, 100)
    assert runner.current_learning_iteration in (3, 4)  # the error is raised soon after the thread has met it
