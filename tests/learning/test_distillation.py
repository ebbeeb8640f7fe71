"""Students: gradients through time, memory and episodes, teachers and their worlds, resumed bits, refusals."""

import copy
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support.reproducible import differences, values
from support.scripts import assert_told_in_one_line, run_here
from support.settings import error_of
from tensordict import TensorDict
from torch import nn

from legged_torque.envs import task_registry
from legged_torque.envs.base.distillation_config import DistillationCfg
from legged_torque.learning import checkpoint
from legged_torque.learning.distillation import Distillation, Teachers, shared_out
from legged_torque.learning.memory import acting
from legged_torque.learning.protocols import Transition
from legged_torque.utils.config import section_keys, set_by_path, to_dict
from legged_torque.utils.options import Options
from legged_torque.utils.task_registry import LoadedRun

WORLDS, STEPS, OBS, ACTIONS = 3, 8, 5, 2
WEIGHTS = [0.0, 1.0]  # of the actions' torques
SMALL = ["--device=cpu", "--num_envs=4", "--logger=none", "--set=runner.num_steps_per_env=4"]
SMALL += ["--set=evaluation.interval=16", "--set=evaluation.num_samples=20"]
OF_TEACHER = ["--task=a1_position", "--set=actor.hidden_dims=[8]", "--set=critic.hidden_dims=[8]"]
OF_TEACHER += ["--set=algorithm.num_mini_batches=2", "--max_iterations=1", "--perturbation=low"]
OF_STUDENT = [
    "--task=a1_position",
    "--preset=student",
    "--set=distillation.gradient_length=4",
    "--set=distillation.num_mini_batches=2",
]
MAP = {"terrain.num_rows": 1, "terrain.num_cols": 4, "terrain.max_init_terrain_level": 0}
OF_STUDENT += [
    "--set=env.history_length=2",
    "--set=distillation.student.rnn_hidden_dim=8",
    "--set=distillation.student.hidden_dims=[8]",
]


class Wise(nn.Module):
    """In place of teachers: a function of what the student does not see."""

    members = ["one"]

    def forward(self, obs):
        return obs["more"]

    def reset(self, dones=None, hidden_state=None):
        pass

    def get_hidden_state(self):
        pass

    def recurrent(self):
        return []


def observations():
    """Random ones, of which the student sees the first group."""
    return TensorDict({"policy": torch.randn(WORLDS, OBS), "more": torch.randn(WORLDS, ACTIONS)}, [WORLDS])


def make_learner(**settings):
    """A learner in a task of which only the observations are known."""
    cfg = to_dict(DistillationCfg()) | {"num_learning_epochs": 1, "num_mini_batches": 1, "gradient_length": STEPS}
    cfg |= settings
    cfg["student"] |= {"rnn_hidden_dim": 4, "hidden_dims": [3], "rnn_type": settings.pop("rnn_type", "gru")}
    cfg["student"]["rnn_num_layers"] = settings.pop("layers", 1)
    train_cfg = {"distillation": cfg, "num_steps_per_env": STEPS, "obs_groups": {"actor": ["policy"]}}
    train_cfg |= {"pretraining": {"function": ""}, "multi_gpu": None, "capture": False}
    env = SimpleNamespace(num_envs=WORLDS, num_actions=ACTIONS, device="cpu", get_observations=observations)
    env.terrain, env.control_law = None, SimpleNamespace(weights=lambda: torch.tensor(WEIGHTS))
    alg = Distillation.construct_algorithm(observations(), env, train_cfg, "cpu")
    alg.teacher = Wise()
    return alg


def roll_out(alg):
    """One rollout with ends of episodes; its observations and ends."""
    seen, ends = [], []
    for _ in range(STEPS):
        obs, dones = observations(), torch.rand(WORLDS) < 0.3
        alg.act(obs)
        alg.observe(Transition(obs, None, torch.zeros(WORLDS), dones, None, obs, None, {}))
        seen.append(obs)
        ends.append(dones)
    return seen, ends


def weighted(errors):
    """The mean square of errors of actions by their weights; those without effect count a hundredth."""
    weights = np.maximum(WEIGHTS, 0.01)
    return (errors.square().mean(dim=0) * torch.from_numpy(weights).float()).sum() / weights.sum()


def by_hand(student, seen, ends, hidden):
    """The loss of a rollout with torch's GRU cell, whose state is 0 after the end of an episode."""
    cell = nn.GRUCell(OBS, 4)
    of_layer = {name.removesuffix("_l0"): value for name, value in student.rnn.rnn.named_parameters()}
    loss = 0.0
    for obs, dones in zip(seen, ends, strict=True):
        hidden = torch.func.functional_call(cell, of_layer, (obs["policy"], hidden))
        loss = loss + weighted(student.mlp(hidden) - obs["more"])
        hidden = hidden * ~dones.unsqueeze(1)
    return loss, hidden


def test_gradients_go_back_in_time():
    """An update's gradients are those of the loss of the rollout, but not through ends of episodes and rollouts."""
    torch.manual_seed(0)
    alg, hidden = make_learner(max_grad_norm=1e9), torch.zeros(WORLDS, 4)
    for _ in range(3):
        seen, ends = roll_out(alg)
        assert any(dones.any() for dones in ends)
        loss, hidden = by_hand(alg.student, seen, ends, hidden.detach())
        learned = [value for name, value in alg.student.named_parameters() if not name.startswith("distribution")]
        expected = torch.autograd.grad(loss, learned)
        numbers = alg.update()
        assert numbers["behavior"] == pytest.approx(float(loss.detach()) / STEPS, rel=1e-5)
        for parameter, gradient in zip(learned, expected, strict=True):
            torch.testing.assert_close(parameter.grad, gradient, rtol=1e-4, atol=1e-6)


def test_steps_without_finite_gradients_are_skipped():
    """They change no weight and are counted, and the loss is that of the others."""
    torch.manual_seed(0)
    alg = make_learner(gradient_length=STEPS // 2)
    seen, ends = roll_out(alg)
    loss, _ = by_hand(alg.student, seen[: STEPS // 2], ends[: STEPS // 2], torch.zeros(WORLDS, 4))
    alg.storage.privileged_actions[STEPS // 2 :] = torch.nan
    numbers = alg.update()
    assert (numbers["skipped_updates"], numbers["all_skipped"]) == (1, False)
    assert numbers["behavior"] == pytest.approx(float(loss.detach()) / (STEPS // 2), rel=1e-5)
    before = copy.deepcopy(alg.student.state_dict())
    roll_out(alg)
    alg.storage.privileged_actions[:] = torch.nan
    numbers = alg.update()
    assert (numbers["skipped_updates"], numbers["all_skipped"]) == (2, True) and "behavior" not in numbers
    assert all(torch.equal(value, before[name]) for name, value in alg.student.state_dict().items())


@pytest.mark.parametrize(("rnn_type", "layers"), [("gru", 1), ("gru", 2), ("lstm", 2), ("none", 1)])
def test_memory_goes_on_from_one_gradient_step_to_the_next(rnn_type, layers):
    """Without learning, the loss of parts of the worlds and of the rollout is that of a student which acts in all."""
    torch.manual_seed(0)
    settings = {"num_mini_batches": WORLDS, "gradient_length": STEPS // 4, "num_learning_epochs": 2}
    alg = make_learner(**settings, rnn_type=rnn_type, layers=layers)
    alg.learning_rate.zero_()
    twin = copy.deepcopy(alg.student)
    for _ in range(2):  # the second rollout begins with a memory
        losses = []
        for obs, dones in zip(*roll_out(alg), strict=True):
            with torch.no_grad():
                losses.append(weighted(twin(obs) - obs["more"]))
            twin.reset(dones)
        assert alg.update()["behavior"] == pytest.approx(float(sum(losses)) / STEPS, rel=1e-5)


def test_the_learning_rate_falls():
    """After half of a training, linearly to 0."""
    alg, rates = make_learner(learning_rate=0.01), []
    for iteration in (0, 5, 6, 9):
        alg.set_progress(iteration, 10)
        rates.append(float(alg.learning_rate))
    assert rates == pytest.approx([0.01, 0.01, 0.008, 0.002])


def test_the_worlds_of_a_cpu():
    """Settings of a run that say no number of worlds, as a teacher's on a CPU, have as many as others there."""
    for given, expected in (({"num_envs": 4096}, 4096), ({}, 64)):
        run = {"env": {"env": given}, "train": {}}
        cfg = task_registry.get_cfgs("a1_position", Options(task="a1_position", device="cpu"), run)[0]
        assert (cfg.env.num_envs, cfg.env.num_envs_cpu) == (expected, 64)


def test_memory_goes_on():
    """A student that is loaded acts as the saved one would have, also if it is saved again before it learns."""
    torch.manual_seed(0)
    alg, loaded, again = make_learner(), make_learner(), make_learner()
    roll_out(alg)
    alg.update()
    for before, after in ((alg, loaded), (loaded, again)):
        after.load(before.state_dict(), None, True)
        after.load_world_state_dict(before.world_state_dict())
    obs = observations()
    with torch.no_grad():
        torch.testing.assert_close(again.student(obs), alg.student(obs), rtol=0.0, atol=0.0)


@pytest.mark.parametrize("rnn_type", ["gru", "lstm"])
def test_a_policy_remembers_its_own_worlds(rnn_type):
    """Elsewhere, too, a network starts each episode with nothing, and forgets nothing of the worlds of its learner."""
    torch.manual_seed(0)
    alg, worlds = make_learner(rnn_type=rnn_type), SimpleNamespace(reset_buf=torch.ones(2, dtype=torch.bool))
    roll_out(alg)
    network, policy = alg.policy(), acting(alg.policy(), lambda: worlds)
    before = torch.utils._pytree.tree_map(torch.clone, network.get_hidden_state())
    given = torch.randn(6, 2, OBS)
    starts = torch.tensor([[True, True], [False, False], [False, True], [False, False], [True, False], [False, False]])
    with torch.no_grad():
        got = []
        for obs, worlds.reset_buf in zip(given, starts, strict=True):
            got.append(policy({"policy": obs}))
        torch.testing.assert_close(network.get_hidden_state(), before)
        for world, episodes in enumerate([[(0, 4), (4, 6)], [(0, 2), (2, 6)]]):
            for start, end in episodes:
                alone = network.mlp(network.rnn.rnn(given[start:end, world])[0])
                torch.testing.assert_close(torch.stack(got)[start:end, world], alone)
    assert acting(make_learner(rnn_type="none").policy(), None).is_recurrent is False


def test_teachers_teach_where_they_have_trained(make_task):
    """Worlds on a kind of ground have its teacher; those on a kind of several, or of none, take turns."""

    def cfg(*kinds):
        env_cfg, _ = task_registry.get_cfgs("a1_rough_torque")
        for name in section_keys(env_cfg.terrain.terrain_proportions):
            setattr(env_cfg.terrain.terrain_proportions, name, float(name in kinds))
        return env_cfg

    grounds = ("smooth_slope_up", "stairs_up", "waves", "gaps")
    shares = to_dict(cfg(*grounds).terrain.terrain_proportions)
    shares = {f"terrain.terrain_proportions.{name}": 0.25 * share for name, share in shares.items()}
    task = make_task("a1_rough_torque", 16, **MAP, **shares)
    cfgs = [cfg("smooth_slope_up", "waves"), cfg("stairs_up", "waves")]
    assert shared_out(cfgs, task) == [0] * 4 + [1] * 4 + [0, 1] * 4
    members = [lambda obs, i=i: torch.full((16, ACTIONS), float(i)) for i in range(2)]
    for member, settings in zip(members, cfgs, strict=True):
        member.cfg = settings
    assert Teachers(members, task)(None)[:, 0].tolist() == [0] * 4 + [1] * 4 + [0, 1] * 4
    levels = {"terrain.num_rows": 2, "terrain.curriculum": False}
    task = make_task("a1_rough_torque", 16, **MAP | levels, **shares)
    taught = zip(task.terrain.levels.tolist()[8:], shared_out(cfgs, task)[8:], strict=True)
    assert sorted(taught) == [(level, teacher) for level in (0, 1) for teacher in (0, 0, 1, 1)]


@pytest.fixture(scope="module")
def teacher(tmp_path_factory):
    """Folder of logs with the run of a teacher, and its name."""
    root = tmp_path_factory.mktemp("teacher")
    assert run_here("train.py", *SMALL, *OF_TEACHER, root=root)[0] == 0
    return root, next((root / "logs" / "a1_position").iterdir()).name


def train(teacher, *words, more=()):
    """Train a student; status, output, error, and the run's folder."""
    root, name = teacher
    before = set((root / "logs" / "a1_position").iterdir())
    result = run_here("train.py", *SMALL, *OF_STUDENT, *words, f"--set=distillation.teachers=[{name}]", root=root)
    return result, *sorted(set((root / "logs" / "a1_position").iterdir()) - before)


def test_a_student_from_command_to_simulation(teacher):
    """Training resumes with the same bits; the student is evaluated, exported and simulated elsewhere."""
    (status, _, _), whole = train(teacher, "--max_iterations=4", "--run_name=whole")
    assert status == 0
    (status, output, _), half = train(teacher, "--max_iterations=2", "--run_name=half")
    assert status == 0 and "Note: exports" not in output
    root = teacher[0]
    words = [f"--load_run={half}", "--resume", "--max_iterations=4", "--logger=none"]
    assert run_here("train.py", *words, root=root)[0] == 0
    first, second = (
        dict(values(checkpoint.read(run / "model_4.pt", "checkpoint", "cpu")))
        for run in (whole, max(half.parent.iterdir(), key=lambda path: path.stat().st_mtime))
    )
    assert len(first) > 40 and first["infos.worlds"] and not differences(first, second)
    assert "push_robots: true" in (whole / "config.yaml").read_text()  # as the teacher's run
    assert run_here("evaluate.py", f"--load_run={whole}", "--num_envs=2", "--steps=3", root=root)[0] == 0
    assert run_here("export.py", f"--load_run={whole}", "--out=out", root=root)[0] == 0
    assert "total_steps: 64" in (root / "out" / "policy.yaml").read_text()  # its own
    assert run_here("sim2sim.py", "out", "--robots=1", "--steps=3", root=root)[0] == 0


def test_curricula_are_those_of_the_first_teacher(teacher):
    """The student's steps are counted on from those of its first teacher, whatever others there are."""
    root, name = teacher
    words = [*SMALL, *OF_TEACHER, "--max_iterations=3", "--run_name=longer"]
    assert run_here("train.py", *words, root=root)[0] == 0
    (longer,) = (root / "logs" / "a1_position").glob("*_longer")
    for first, second, steps in ((name, longer.name, 16), (longer.name, name, 48)):
        words = [*SMALL, *OF_STUDENT, "--max_iterations=1", f"--run_name=of{steps}"]
        assert run_here("train.py", *words, f"--set=distillation.teachers=[{first},{second}]", root=root)[0] == 0
        (run,) = (root / "logs" / "a1_position").glob(f"*_of{steps}")
        state = checkpoint.read(run / "model_1.pt", "checkpoint", "cpu")
        assert state["infos"]["task"]["total_steps"] == steps + 16
        rows = (run / "evaluations.csv").read_text().splitlines()
        assert [row.split(",")[0] for row in rows] == ["steps", "16"]  # its own


def test_a_teacher_that_sees_random_parameters(teacher):
    """It knows them as shares of their ranges: with other ranges neither its student nor who measures it takes it."""
    root, _ = teacher
    words = [*SMALL, *OF_TEACHER, "--set=obs_groups.actor=[critic]", "--run_name=critic"]
    assert run_here("train.py", *words, root=root)[0] == 0
    (seer,) = (root / "logs" / "a1_position").glob("*critic")
    student = ["train.py", *SMALL, *OF_STUDENT, f"--set=distillation.teachers=[{seer.name}]", "--max_iterations=1"]
    measure = ["evaluate.py", "--device=cpu", "--num_envs=4", "--steps=4", f"--load_run={seer}"]
    for script in (student, measure):
        assert run_here(*script, root=root)[0] == 0
        assert_told_in_one_line(run_here(*script, "--ranges=hard", root=root), "needs the training's domain_rand.")


KEPT = {"domain_rand.keep_fixed": ["gravity", "trunk_mass"]}


@pytest.mark.parametrize(
    ("name", "before", "change", "told"),
    [
        ("a1_rough_torque", {}, {"terrain.measure_heights": True}, "terrain.measure_heights, False, not True"),
        ("a1_torque", KEPT, {"domain_rand.keep_fixed": ["gravity"]}, "keep_fixed, ['gravity', 'trunk_mass'], not ['"),
        ("a1_torque", {}, {"motors.ideal.draws": {"x": {"set": [0, 1]}}}, "draws of motors.chain, [], not [('ideal.x'"),
        ("a1_torque", KEPT, {"domain_rand.keep_fixed": ["trunk_mass", "gravity"], "noise.add_noise": True}, ""),
    ],
)
def test_what_a_policy_that_sees_all_needs(name, before, change, told):
    """Order and scales of what it sees must be those of its training, all else may change."""
    trained, now = (task_registry.get_cfgs(name)[0] for _ in range(2))
    train_cfg = task_registry.get_cfgs(name)[1]
    for cfg, changes in ((trained, before), (now, before | change)):
        for path, value in changes.items():
            set_by_path(cfg, path, value)
    config = {"task": name, "env": to_dict(trained), "train": {}}
    run = LoadedRun(Path("run"), config, trained, train_cfg, Path("model_1.pt"))
    task_registry.check_ranges(run, now)
    train_cfg.obs_groups.actor = ["critic"]
    if told:
        assert told in error_of(task_registry.check_ranges, run, now)
    else:
        task_registry.check_ranges(run, now)


def test_refusals(teacher):
    """No teacher, one that does not exist or is of another task or control, and settings that are not read."""
    root, name = teacher
    told = {
        "--set=distillation.teachers=[]": "a student needs teachers",
        "--set=distillation.teachers=[nobody]": "unknown run 'nobody'",
        "--set=distillation.teachers=[other.pt]": "'other.pt' is no whole checkpoint",
        "--set=control.action_scale=0.5": "has control.action_scale=",
        "--set=motors.chain=[delay, drive, ideal]": "has motors.chain (control law)=[], its student ['drive']",
        "--set=distillation.gradient_length=3": "gradient_length must divide runner.num_steps_per_env, 4, not be 3",
        "--set=distillation.num_mini_batches=5": "num_mini_batches is 5, more than the 4 worlds",
        "--set=algorithm.learning_rate=1e-4": "is not read by legged_torque.learning.distillation:Distillation",
        "--task=a1_torque": "is of task 'a1_position', not 'a1_torque'",
    }
    forgetful = [*SMALL, "--preset=student", "--set=distillation.student.rnn_type=none"]
    result = run_here("train.py", *forgetful, "--set=distillation.student.rnn_hidden_dim=7", root=root)
    assert_told_in_one_line(result, "rnn_hidden_dim is not read: distillation.student.rnn_type is none")
    before = set(root.rglob("*"))
    for word, message in told.items():
        words = [*SMALL, *OF_STUDENT, f"--set=distillation.teachers=[logs/a1_position/{name}]", word]
        if "[other" in word or "nobody" in word:
            words = [*SMALL, *OF_STUDENT, word]
        assert_told_in_one_line(run_here("train.py", *words, root=root), message)
    assert set(Path(root).rglob("*")) == before
    longer = Path(shutil.copytree(root / "logs" / "a1_position" / name, root / "longer"))
    config = (longer / "config.yaml").read_text()
    (longer / "config.yaml").write_text(config.replace("history_length: 1\n", "history_length: 3\n"))
    result = run_here("train.py", *SMALL, *OF_STUDENT, f"--set=distillation.teachers=[{longer}]", root=root)
    assert_told_in_one_line(
        result, f"env.history_length must be at least that of the teacher '{longer}/model_1.pt', 3, not 2"
    )
    broken = Path(shutil.copytree(root / "logs" / "a1_position" / name, root / "broken"))
    for text in ("env: 3", "env: {env: 3}"):
        (broken / "config.yaml").write_text(f"task: a1_position\n{text}\ntrain: {{}}\n")
        words = [*SMALL, *OF_STUDENT, f"--set=distillation.teachers=[{broken}]"]
        assert_told_in_one_line(run_here("train.py", *words, root=root), "'env' is a section with entries")
