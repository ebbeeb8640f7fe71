"""Training in two processes: one policy, one run, and what every process does of its own.

Started by torchrun, this file is the process that trains and notes what it sees.
"""

import contextlib
import os
import re
import runpy
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from support.reproducible import differences, values
from support.rollouts import make_ppo, record_rollout, state_of
from support.scripts import PATHS, ROOT
from support.settings import parse

from legged_torque.envs import task_registry
from legged_torque.learning.checkpoint import on_host
from legged_torque.learning.guard import PATIENCE
from legged_torque.utils import distributed
from legged_torque.utils.config import to_dict
from legged_torque.utils.errors import TrainingError
from legged_torque.utils.runs import checkpoint_number, find_checkpoint
from legged_torque.utils.task_registry import set_seed

WORLDS, STEPS = 2, 4
ALL_STEPS = 2 * WORLDS * STEPS
"""Environment steps of an iteration of both processes."""
SMALL = [f"--num_envs={WORLDS}", f"--set=runner.num_steps_per_env={STEPS}", "--set=algorithm.num_mini_batches=2"]
SMALL += ["--set=algorithm.annealing_start=1", "--set=evaluation.interval=0"]  # trainings of other lengths are compared
TASK = "a1_multihead"
FOREVER = 1_000_000
RUN = Path("0", TASK, "2026-01-01_00-00-00")
"""The run of two iterations, which only the first machine has."""
FORMULA = {"num_mini_batches": 1, "schedule": "adaptive", "max_grad_norm": 1e6, "learning_rate": 1e-3}
MULTI_GPU = {"world_size": 2, "local_rank": 0}


def make_runner(log_root, normalized=False):
    """The runner of this process, whose critic may normalize its observations; the first one begins its run."""
    args = parse(f"--task={TASK}", *SMALL)
    env_cfg, train_cfg = task_registry.get_cfgs(args.task, args)
    train_cfg.runner.logger = "none"
    if normalized:

        class Normalizing(type(train_cfg.critic)):
            obs_normalization: bool = True

        train_cfg.critic = Normalizing()
    set_seed(train_cfg.seed)
    env, _ = task_registry.make_env(args.task, args, env_cfg)
    runner, _ = task_registry.make_alg_runner(env, args.task, train_cfg=train_cfg, log_root=log_root)
    if log_root and distributed.rank() == 0:
        runner.claim_log_dir({"task": TASK, "env": to_dict(env_cfg), "train": to_dict(train_cfg)})
    return runner


def everything(runner):
    """Copies of what training has changed, counters included."""
    return {
        **state_of(runner.alg),
        "total_steps": runner.env.total_steps.clone(),
        "iterations": torch.tensor(runner.current_learning_iteration),
    }


def train(folder):
    """Train, stop when the second process is asked to, save, load in both processes, and go on."""
    runner = make_runner(folder / "logs")
    start = everything(runner)
    runner.learn(2, init_at_random_ep_len=True)
    notes = {"start": start, "trained": everything(runner), "observations": runner.env.obs_buf["policy"].clone()}
    kept = folder / RUN  # as it would be if training had stopped here
    if distributed.rank() == 0:
        shutil.copytree(runner.log_dir, kept)
    distributed.any_process(False, "cpu")  # waits for the copy
    runner.learn(1)
    notes["third"] = everything(runner)
    update = runner.alg.update

    def update_with_signal():
        if distributed.rank() == 1 and runner.current_learning_iteration == 3:
            signal.raise_signal(signal.SIGTERM)
        return update()

    runner.alg.update = update_with_signal
    runner.learn(FOREVER)
    notes["stopped"] = everything(runner)
    resumed = make_runner(None)
    resumed.load(str(kept / "model_2.pt"))
    notes["loaded"] = everything(resumed)
    resumed.resume(str(kept / "model_2.pt"))
    resumed.learn(1)
    notes["resumed"] = everything(resumed)
    normalized = make_runner(None, normalized=True)
    normalized.learn(2)
    notes["normalized"] = everything(normalized)
    notes["given_up"] = give_up()
    return notes


def give_up():
    """Train with bad commands from the second iteration on: in one world of the first process, in both of the other."""
    runner = make_runner(None)
    update = runner.alg.update

    def update_and_spoil():
        runner.env.commands[: 1 + distributed.rank()] = torch.nan
        return update()

    runner.alg.update = update_and_spoil
    with pytest.raises(TrainingError) as error:
        runner.learn(100)
    return {"iterations": runner.current_learning_iteration, "reason": str(error.value)}


def own(rank):
    """Containers of a process, of shapes, types and strides that differ."""
    tensors = {"bits": torch.arange(3 + rank) % 2 == 0, "none": torch.empty(0, 2), "one": torch.tensor(0.5 + rank)}
    tensors["complex"] = torch.full((1, 2), 1.0 + rank * 1j, dtype=torch.complex128).T
    return {"tensors": tensors, "words": ["a", rank, None]} | ({"more": torch.ones(5)} if rank else {})


def average():
    """Learn from one minibatch per process, in the second case from bad numbers in one process."""
    notes = {}
    for name, spoiled in (("good", False), ("spoiled", True)):
        alg = make_ppo(multi_gpu_cfg={**MULTI_GPU, "global_rank": distributed.rank()}, **FORMULA)
        record_rollout(alg, seed=1 + distributed.rank())
        if spoiled and distributed.rank() == 1:
            alg.storage.returns[3, 1] = torch.nan
        before = state_of(alg)
        report = alg.update()
        gradients = [p.grad.clone() for p in (*alg.actor.parameters(), *alg.critic.parameters())]
        notes[name] = {"before": before, "after": state_of(alg), "report": report, "gradients": gradients}
    return notes


def main(folder):
    """Do both and keep the notes; then resume with train.py, each in a folder of its own, until torchrun ends."""
    distributed.join("cpu")
    notes = {"average": average(), **train(folder)}
    notes["gathered"] = on_host(distributed.gather_tensors(own(distributed.rank()), "cpu"))
    torch.save(notes, folder / f"{distributed.rank()}.pt")
    words = [f"--task={TASK}", "--device=cpu", "--logger=none", "--verbose", "--resume"]
    words += [f"--max_iterations={FOREVER}", "--set=runner.save_interval=1"]
    sys.argv = ["train.py", *words, f"--log_root={folder / str(distributed.rank())}"]
    runpy.run_path(str(ROOT / "scripts" / "train.py"), run_name="__main__")


def torchrun(*words):
    """Start a process on each of two machines, here the same one, with the options of the page about clusters."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = os.environ | PATHS | {"PYTHONUNBUFFERED": "1", "OMP_NUM_THREADS": "1"}
    how = {"cwd": ROOT, "env": environment, "text": True, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    page = (ROOT / "docs" / "howto" / "cluster.md").read_text()
    ours = {"--nproc_per_node": 1, "--master_addr": "127.0.0.1", "--master_port": port}
    for line in re.findall(r"^torchrun (.+) scripts/train.py", page, flags=re.MULTILINE):  # as they stand there
        options = dict(word.split("=") for word in line.split())
        assert ours.keys() < options.keys()
        launch = [f"{name}={value}" for name, value in (options | ours).items()]
        yield subprocess.Popen([sys.executable, "-m", "torch.distributed.run", *launch, *map(str, words)], **how)


def read_until(process, text):
    """What a process prints, until a line has some text."""
    output = ""
    for line in process.stdout:
        output += line
        if text in line:
            break
    return output


@pytest.fixture(scope="module")
def together(tmp_path_factory):
    """The folder in which two processes have trained, the notes of both, and what each of both has printed."""
    folder = tmp_path_factory.mktemp("together")
    (folder / "1").mkdir()
    with contextlib.ExitStack() as stack:
        both = [stack.enter_context(process) for process in torchrun(__file__, folder)]
        output = read_until(both[0], "Learning iteration 5/")
        for process in both:
            process.kill()
        output += both[0].communicate(timeout=300)[0]  # which waits for all of them
        other = both[1].communicate(timeout=300)[0]
    assert {file.name for file in folder.glob("?.pt")} == {"0.pt", "1.pt"}, output + other
    return folder, [torch.load(folder / f"{rank}.pt", weights_only=True) for rank in range(2)], output, other


def test_containers_are_gathered(together):
    """The first process gets those of both, of whatever shape and type; the other one nothing."""
    _, (first, second), *_ = together
    assert second["gathered"] == [] and len(first["gathered"]) == 2
    for rank, found in enumerate(first["gathered"]):
        assert not differences(dict(values(found)), dict(values(own(rank))))


def test_one_policy_in_different_worlds(together):
    """Both start with other numbers, see other things, and yet have the same networks, moments and learning rate."""
    _, (first, second), *_ = together
    assert differences(first["start"], second["start"])
    assert not torch.equal(first["observations"], second["observations"])
    for moment in ("trained", "stopped", "resumed", "normalized"):
        assert not differences(first[moment], second[moment])
    assert differences(first["trained"], first["stopped"])
    assert int(first["normalized"]["critic.obs_normalizer.count"]) == 2 * ALL_STEPS


def test_steps_of_both_count(together):
    """The task's counter, on which curricula depend, and the checkpoint's are those of both processes."""
    folder, (first, second), output, _ = together
    for notes in (first, second):
        assert int(notes["trained"]["total_steps"]) == 2 * ALL_STEPS
    (run,) = (folder / "logs").iterdir()
    state = torch.load(run / "model_2.pt", weights_only=True)
    assert state["iter"] == 2 and state["infos"]["total_timesteps"] == 2 * ALL_STEPS
    assert int(state["infos"]["task"]["total_steps"]) == 2 * ALL_STEPS
    lines = re.findall(r"^iteration (\d) of \d, .*?; steps (\d+)(?:;|$)", output, flags=re.MULTILINE)
    assert (str(2), str(2 * ALL_STEPS)) in lines
    assert len(lines) == len(set(lines))  # of the first process alone, the other one prints nothing


def test_a_signal_to_one_process_stops_both(together):
    """Both finish the iteration in which the second one was asked to stop, and the first one saves."""
    folder, (first, second), *_ = together
    assert int(first["stopped"]["iterations"]) == int(second["stopped"]["iterations"]) == 4
    (run,) = (folder / "logs").iterdir()
    files = {"config.yaml", "worlds_4.pt", *(f"model_{iterations}.pt" for iterations in (0, 2, 3, 4))}
    assert {path.name for path in run.iterdir() if path.is_file()} >= files


def test_both_resume(together):
    """Both continue from the checkpoint, each in its worlds: the next iteration is that of the run, bit by bit."""
    _, (first, second), output, _ = together
    assert not differences(first["resumed"], first["third"]) and not differences(second["resumed"], second["third"])
    assert differences(first["third"], first["trained"]) and "start anew" not in output
    assert not differences(first["loaded"], second["loaded"]) and not differences(first["loaded"], first["trained"])
    assert int(first["resumed"]["iterations"]) == 3 and int(first["resumed"]["total_steps"]) == 3 * ALL_STEPS


def test_both_give_up(together):
    """Both stop after the same iteration, since three of all four worlds are bad; the first one warns."""
    _, (first, second), output, _ = together
    assert first["given_up"] == second["given_up"]
    assert first["given_up"]["iterations"] == 1 + PATIENCE
    assert "75%" in first["given_up"]["reason"] and "buffer 'commands' 3" in first["given_up"]["reason"]
    assert output.count("Warning: buffer 'commands' was not finite; resets of worlds for it: 3.") == 1


def test_gradients_and_losses_are_those_of_all_samples(together):
    """Losses over the samples of both, and their gradients, are the means of those that each has alone."""
    _, notes, *_ = together
    first, second = (each["average"]["good"] for each in notes)
    assert not differences(first["before"], second["before"]) and not differences(first["after"], second["after"])
    gradients, losses = [], []
    for rank in range(2):
        alg = make_ppo(**FORMULA)
        record_rollout(alg, seed=1 + rank)
        losses.append(alg.update())
        gradients.append([p.grad for p in (*alg.actor.parameters(), *alg.critic.parameters())])
    for mine, other, *alone in zip(first["gradients"], second["gradients"], *gradients, strict=True):
        assert torch.equal(mine, other) and not torch.equal(*alone)
        torch.testing.assert_close(mine, sum(alone) / 2, rtol=1e-4, atol=1e-6)
    assert first["report"] == second["report"]
    for name in ("value", "surrogate", "entropy", "kl"):
        assert first["report"][name] == pytest.approx((losses[0][name] + losses[1][name]) / 2, rel=1e-4, abs=1e-6)
    assert losses[0]["value"] != pytest.approx(losses[1]["value"], rel=1e-2)


def test_bad_numbers_in_one_process_are_skipped_by_both(together):
    """Neither learns from a minibatch that is bad in one of them; nothing moves by a bit."""
    _, notes, *_ = together
    for spoiled in (each["average"]["spoiled"] for each in notes):
        assert spoiled["report"]["skipped_updates"] == 1
        before = {key: value for key, value in spoiled["before"].items() if not key.startswith("adam")}
        after = {key: value for key, value in spoiled["after"].items() if not key.startswith("adam")}
        assert not differences(before, after)


def test_two_machines_without_shared_files(together):
    """Both go on from the first one's run, with its bits, one folder, one output; they end with torchrun, and save."""
    folder, _, output, other = together
    assert output.count(f"Training {TASK} on 2 x CPU") == output.count("Learning iteration 3/") == 1, output + other
    assert f"{2 * WORLDS} worlds" in output and "start anew" not in output
    assert "Learning iteration" not in other and not list((folder / "1").iterdir())
    (resumed,) = (path for path in (folder / RUN).parent.iterdir() if path.name != RUN.name)
    assert output.count(f"The run is in {resumed}") == 1
    last = find_checkpoint(resumed, None)
    count = checkpoint_number(last)
    assert count > 4 and torch.load(last, weights_only=True)["infos"]["total_timesteps"] == count * ALL_STEPS
    config = yaml.safe_load((resumed / "config.yaml").read_text())
    assert config["processes"] == 2 and config["env"]["env"]["num_envs"] == WORLDS
    file = next((folder / "logs").glob("*/model_3.pt"))
    one, twin = (dict(values(torch.load(path, weights_only=True))) for path in (file, resumed / file.name))
    assert not differences(one, twin)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
