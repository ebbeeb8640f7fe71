"""A resumed training gives the same bits as one that never stopped, or says in a line why its worlds start anew."""

import re
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp
from support.resume import WORLDS, content, differences, start, train
from support.settings import error_of

from legged_torque.envs import task_registry
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.learning import checkpoint
from legged_torque.learning.worlds import pack, unpack, world_tensors
from legged_torque.utils.errors import UserError
from legged_torque.utils.options import Options
from tools.reproducible import values


def without_seconds(lines):
    """The cells of a table, apart from times."""
    column = lines[0].split(",").index("seconds")
    return [[cell for i, cell in enumerate(line.split(",")) if i != column] for line in lines]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run of four iterations."""
    return train(tmp_path_factory.mktemp("whole"), 4)


@pytest.fixture(scope="module")
def half(tmp_path_factory):
    """A run of two iterations, whose folder stays as it is."""
    return train(tmp_path_factory.mktemp("half"), 2)


@pytest.fixture
def copied(half, tmp_path):
    """A copy of the folder of the run of two iterations."""
    return Path(shutil.copytree(half.log_dir, tmp_path / "run"))


def test_two_and_two_are_four(whole, half, tmp_path):
    """Networks, moments, random numbers, worlds and evaluations are the same bits."""
    resumed = start(tmp_path, "--resume", f"--load_run={half.log_dir}")
    resumed.claim_log_dir({})
    resumed.learn(2, init_at_random_ep_len=True)
    first, second = content(whole, 4), content(resumed, 4)
    assert len(first) > 100 and first["infos.worlds"] and not differences(first, second)
    for name, count in {"evaluations.csv": 4, "evaluations_high.csv": 3}.items():
        rows = [(Path(runner.log_dir) / name).read_text().splitlines() for runner in (whole, half, resumed)]
        assert len(rows[0]) == count + 1  # with the header
        assert without_seconds(rows[0]) == without_seconds(rows[1] + rows[2][1:])


def test_two_and_two_are_four_with_mujoco_warp(tmp_path):
    """The other engine keeps nothing else from step to step."""
    words = ["--set=sim.engine=mujoco_warp", "--set=evaluation.interval=0"]
    whole, half = (train(tmp_path / name, count, *words) for name, count in (("whole", 4), ("half", 2)))
    resumed = start(tmp_path / "resumed", *words, "--resume", f"--load_run={half.log_dir}")
    resumed.claim_log_dir({})
    resumed.learn(2, init_at_random_ep_len=True)
    assert not differences(content(whole, 4), content(resumed, 4))


def reachable(value, name="env", seen=None):
    """Every tensor, and every array of the simulator's model, that attributes of an object lead to."""
    seen = seen if seen is not None else {}
    if id(value) in seen or isinstance(value, (str, type)):
        return {}
    seen[id(value)] = value
    if isinstance(value, torch.Tensor):
        return {name: value.clone()}
    if isinstance(value, wp.array):
        return {name: torch.from_numpy(value.numpy().copy())} if value.dtype in (wp.float32, wp.vec2, wp.vec3) else {}
    parts = value if isinstance(value, dict) else getattr(value, "__dict__", {})
    if isinstance(value, (list, tuple)):
        parts = dict(enumerate(value))
    if hasattr(value, "batch_size"):  # a TensorDict
        parts = dict(value.items())
    if type(value).__name__ in (
        "FusedStep",
        "WarpStep",
        "DerivedConstants",
        "Data",
        "CudaGraph",
        "Device",
        "Asset",
        "Drive",
    ):
        return {}  # scratch, what a step writes before it reads it, and what is found elsewhere
    found = {}
    for key, part in parts.items():
        found |= reachable(part, f"{name}.{key}", seen)
    return found


@pytest.mark.filterwarnings("ignore")
def test_every_tensor_comes_back(half, tmp_path):
    """Whatever the task holds after two iterations, a task that has just resumed holds as well."""
    before, after = reachable(half.env), reachable(start(tmp_path, "--resume", f"--load_run={half.log_dir}").env)
    assert {"env.sim.qpos", "env.sim.qacc_warmstart", "env.actions", "env.sim.fields.body_invweight0"} <= before.keys()
    assert len(before) > 100
    fresh = reachable(start(tmp_path).env)
    assert len(differences(before, fresh)) > 30  # or the comparison would say nothing
    made_later = {name for name in before if name.startswith("env.mirror.")}
    assert set(differences(before, after)) == made_later


class OwnTask(LeggedRobot):
    """A task of a user's, with tensors of its own in several places."""

    class Helper:
        """An object that keeps something."""

        def __init__(self, num_envs):
            self.phases = [torch.zeros(num_envs, 2)]

    def _init_buffers(self):
        super()._init_buffers()
        self.clock, self.helper = torch.zeros(self.num_envs, dtype=torch.long), self.Helper(self.num_envs)
        self.by_foot = {"height": torch.zeros(4, self.num_envs)}


def test_tensors_of_a_users_task_are_found():
    """They are kept wherever they are and wherever their axis of worlds stands; what cannot change is not."""
    env_cfg, _ = task_registry.get_cfgs("a1_position", Options(device="cpu", num_envs=12))
    task, other = OwnTask(env_cfg), OwnTask(env_cfg)
    assert len(task.mirror.maps) > 0  # made when it is first asked for, with tensors of 12 numbers
    task.clock.random_(100)
    task.helper.phases[0].normal_()
    task.by_foot["height"].normal_()
    found = world_tensors(task)
    assert {"clock", "helper.phases.0", "by_foot.height", "sim.qpos", "rewards.episode_sums"} <= found.keys()
    assert not {"_gravity", "feet_indices"} & found.keys()
    unpack(pack(found, 12), world_tensors(other), 12)
    for name, tensor in world_tensors(other).items():
        assert torch.equal(tensor, found[name]), name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int64, torch.int32, torch.bool])
@pytest.mark.parametrize("shape", [(5,), (5, 3), (2, 5, 3), (3, 5), (5, 1, 2)])
def test_packing(dtype, shape):
    """Every bit comes back, those of numbers that are not finite too, also into views of larger memory."""
    noise = torch.randint(0, 256, (*shape, 8), dtype=torch.uint8)
    tensor = noise.view(torch.float64).squeeze(-1) if dtype == torch.float64 else (noise[..., 0].float() - 7).to(dtype)
    room = torch.zeros(*shape, 2, dtype=dtype)
    unpack(pack({"x": tensor}, 5), {"x": room[..., 1]}, 5)
    assert room[..., 1].numpy().tobytes() == tensor.contiguous().numpy().tobytes()
    assert not room[..., 0].any()


@pytest.mark.parametrize("num_worlds", [1, 3])
def test_packing_of_odd_strides(num_worlds):
    """Columns of a matrix whose other axis has one entry, and a single world, come back too."""
    tensors = {"x": torch.rand(num_worlds, 5)[:, 2:3], "y": torch.rand(4, num_worlds).T[:, :1], "z": torch.rand(4, 1).T}
    tensors = {name: tensor for name, tensor in tensors.items() if num_worlds in tensor.shape}
    copies = {name: torch.zeros(tensor.shape) for name, tensor in tensors.items()}
    unpack(pack(tensors, num_worlds), copies, num_worlds)
    assert not differences(tensors, copies)


def spoil(key, value):
    """A function that replaces an entry."""
    return lambda packed: packed.__setitem__(key, value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (spoil("layout", []), "keeps other tensors than it did: x"),
        (spoil("layout", [["x", "torch.float64", [5, 3]]]), "keeps other tensors"),
        (spoil("places", torch.tensor([0, 1], dtype=torch.int32)), "not as large|larger"),
        (spoil("planes", []), "not as large"),
        (spoil("planes", [torch.zeros(9, dtype=torch.uint8)]), "cannot be decompressed"),
        (lambda packed: packed["places"].fill_(-1), "not as large|larger"),
        (lambda packed: packed["planes"].append(packed["planes"][0]), "not as large"),
    ],
)
def test_worlds_that_do_not_fit_are_not_written(change, message):
    """Not a number changes when what is read has other names, types or sizes."""
    packed, target = pack({"x": torch.rand(5, 3)}, 5), torch.ones(5, 3)
    change(packed)
    with pytest.raises(UserError, match=message):
        unpack(packed, {"x": target}, 5)
    assert torch.equal(target, torch.ones(5, 3))


def test_worlds_of_a_large_training_are_small(tmp_path):
    """4096 worlds of training and as many of evaluation take 16 MB at most."""
    options = Options(device="cpu", num_envs=4096, perturbation="low")
    env_cfg, _ = task_registry.get_cfgs("a1_torque_multihead", options)
    torch.manual_seed(0)
    env, _ = task_registry.make_env("a1_torque_multihead", options, env_cfg)
    for _ in range(3):
        env.step(torch.randn(4096, env.num_actions))
    checkpoint.write(tmp_path / "worlds.pt", pack(world_tensors(env), 4096))
    assert 1e6 < (tmp_path / "worlds.pt").stat().st_size < 8e6


def test_only_the_last_worlds_are_kept(half):
    """They are those of the last checkpoint, and are no checkpoint themselves."""
    files = {path.name for path in Path(half.log_dir).iterdir() if path.is_file()}
    assert files == {
        "config.yaml",
        "evaluations.csv",
        "evaluations_high.csv",
        "model_0.pt",
        "model_1.pt",
        "model_2.pt",
        "worlds_2.pt",
    }


@pytest.mark.parametrize("ends_at", ["worlds_3.pt", "model_3.pt"])
def test_an_end_between_worlds_and_checkpoint(half, tmp_path, monkeypatch, ends_at):
    """Whichever of both cannot be written any more, the last checkpoint has its worlds."""
    write = checkpoint.write

    def write_or_end(file, state):
        if file.name == ends_at:
            raise KeyboardInterrupt
        return write(file, state)

    runner = train(tmp_path, 2)
    monkeypatch.setattr(checkpoint, "write", write_or_end)
    with pytest.raises(KeyboardInterrupt):
        runner.learn(1)
    monkeypatch.undo()
    resumed = start(tmp_path, "--resume", f"--load_run={runner.log_dir}")
    assert resumed.current_learning_iteration == 2
    assert not differences(world_tensors(resumed.env), world_tensors(half.env))


def damage(file):
    """Flip bits all over the middle of a file, some of which are data and not filling."""
    data = bytearray(file.read_bytes())
    for place in range(len(data) // 3, len(data) // 2, 50):
        data[place] ^= 4
    file.write_bytes(data)


HIGH = "--set=evaluation.perturbation=high"
ANEW = {
    "another number": (lambda run: None, [f"--num_envs={WORLDS + 1}"], "env.num_envs is 7, was 6"),
    "another setting": (lambda run: None, ["--set=control.stiffness=21"], "control.stiffness is 21.0, was 20.0"),
    "evaluated elsewhere": (
        lambda run: None,
        ["--set=evaluation.perturbation=high"],
        "evaluation.perturbation is hi",
    ),
    "an older one": (lambda run: None, ["--checkpoint=1"], "only the last checkpoint of a run keeps them"),
    "missing": (lambda run: (run / "worlds_2.pt").unlink(), [], "there is no '"),
    "damaged": (lambda run: damage(run / "worlds_2.pt"), [], "is damaged or belongs to another checkpoint"),
    "cut": (lambda run: (run / "worlds_2.pt").write_bytes(b"PK"), [], "is damaged or belongs to another checkpoint"),
}


@pytest.mark.parametrize("case", ANEW)
def test_worlds_start_anew(copied, tmp_path, capsys, case):
    """One line says why, and training goes on with the networks."""
    change, words, message = ANEW[case]
    change(copied)
    capsys.readouterr()
    runner = start(None, f"--num_envs={WORLDS}", *words, "--resume", f"--load_run={copied}")
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "anew" in line]
    assert line.startswith("The worlds start anew: ") and message in line
    assert int(runner.env.episode_length_buf.max()) == 0
    runner.learn(1, init_at_random_ep_len=True)
    assert runner.current_learning_iteration == (2 if case == "an older one" else 3)


def test_another_number_of_processes(copied, tmp_path, capsys):
    """It is told like another setting."""
    file, model = copied / "worlds_2.pt", copied / "model_2.pt"
    content = torch.load(file, weights_only=True)
    digest = checkpoint.write(file, {**content, "processes": content["processes"] * 2})
    state = torch.load(model, weights_only=True)
    state["infos"]["worlds"] = digest
    torch.save(state, model)
    capsys.readouterr()
    start(None, "--resume", f"--load_run={copied}")
    assert "anew: 2 processes have trained, now there are 1." in capsys.readouterr().out


def test_checkpoints_of_older_versions(copied, capsys):
    """They have no worlds, and training goes on from them."""
    (copied / "worlds_2.pt").unlink()
    state = torch.load(copied / "model_2.pt", weights_only=True)
    del state["infos"]["worlds"]
    torch.save(state, copied / "model_2.pt")
    runner = start(None, "--resume", f"--load_run={copied}")
    assert "The worlds start anew" in capsys.readouterr().out and runner.current_learning_iteration == 2


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


def test_a_damaged_run_is_passed_over(half, tmp_path, capsys):
    """If the newest run has nothing but damaged checkpoints, the one before is taken, and a line says so."""
    folder = tmp_path / "a1_torque_multihead"
    for name in ("2026-01-01", "2026-01-02"):
        shutil.copytree(half.log_dir, folder / name)
    for file in folder.glob("2026-01-02/*.pt"):
        file.write_bytes(b"")
    runner = start(None, "--resume", f"--log_root={tmp_path}")
    assert f"Newer checkpoints than '{folder / '2026-01-01' / 'model_2.pt'}' are damaged" in capsys.readouterr().out
    assert runner.current_learning_iteration == 2


def test_flipped_bits_are_found(half, tmp_path):
    """Wherever a bit flips, the checkpoint is refused, unless the bit means nothing."""
    whole, file = Path(half.log_dir, "model_2.pt").read_bytes(), tmp_path / "model_2.pt"
    expected, refused = content(half, 2), 0
    for place in np.random.default_rng(0).integers(0, len(whole), 200):
        data = bytearray(whole)
        data[place] ^= 1 << int(place % 8)
        file.write_bytes(data)
        try:
            state = checkpoint.read(file, "checkpoint", "cpu")
        except UserError:
            refused += 1
        else:  # between the data
            assert not differences(expected, dict(values(state)))
    assert refused > 100


BAD = {
    "actor_state_dict": lambda state: next(iter(state["actor_state_dict"].values())).fill_(torch.nan),
    "optimizer_state_dict": lambda state: state["optimizer_state_dict"]["state"][3]["exp_avg_sq"].fill_(torch.inf),
    "lr": lambda state: state["optimizer_state_dict"]["param_groups"][0]["lr"].fill_(torch.nan),
    "iter": lambda state: state.__setitem__("iter", "2"),
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


def test_what_killed_processes_have_left_is_removed(copied):
    """Those of processes that run are not touched."""
    dead, alive = copied / "model_3.pt.999999999.part", copied / "model_3.pt.1.part"
    for file in (dead, alive):
        file.touch()
    start(None, "--resume", f"--load_run={copied}")
    assert not dead.exists() and alive.exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_every_signal_saves(tmp_path, number):
    """Training ends after the iteration, saves, and knows what has stopped it."""
    runner = start(tmp_path)
    runner.claim_log_dir({})
    update = runner.alg.update
    runner.alg.update = lambda: (signal.raise_signal(number), update())[1]
    runner.learn(5)
    assert (runner.stopped_by, runner.current_learning_iteration) == (number, 1)
    assert (Path(runner.log_dir) / "model_1.pt").is_file()


@pytest.mark.parametrize("fault", [OSError(28, "No space left on device"), RuntimeError("broken")])
def test_curves_that_cannot_be_written(tmp_path, capsys, fault):
    """Training goes on without them and leaves its checkpoint; a line says so once."""

    class Writer:
        """Fails from the first number on."""

        def add_scalar(self, *_):
            raise fault

    runner = start(tmp_path)
    runner.claim_log_dir({})
    runner.logger.init_logging_writer = lambda: setattr(runner.logger, "writer", Writer())
    runner.learn(3)
    output, error = capsys.readouterr()
    assert error.count("\n") == 1 and error.startswith("Warning: logs end here: ")
    assert re.findall(r"iteration (\d) of 3", output)[-1] == "3" and (Path(runner.log_dir) / "model_3.pt").is_file()
    assert runner.logger.tot_timesteps == 3 * 4 * WORLDS


def test_worlds_that_cannot_be_written(tmp_path, capsys):
    """The checkpoint is kept without them, and the last worlds stay beside their own."""
    runner = train(tmp_path, 1)
    (Path(runner.log_dir) / "worlds_2.pt").mkdir()
    runner.learn(1)
    assert capsys.readouterr().err.startswith("Warning: worlds would start anew in a resumed run: cannot write '")
    files = {path.name for path in Path(runner.log_dir).glob("*.pt*") if path.is_file()}
    assert files == {"model_0.pt", "model_1.pt", "worlds_1.pt", "model_2.pt"}
    start(None, "--resume", f"--load_run={runner.log_dir}")
    assert "The worlds start anew" in capsys.readouterr().out


def test_an_evaluation_that_cannot_be_written(tmp_path, capsys):
    """Training goes on and leaves its checkpoint."""
    runner = start(tmp_path)
    runner.claim_log_dir({})
    (Path(runner.log_dir) / "evaluations.csv").mkdir()
    runner.learn(1)
    assert "Warning: an evaluation is not kept: cannot write '" in capsys.readouterr().err
    assert (Path(runner.log_dir) / "model_1.pt").is_file()
