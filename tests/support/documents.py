"""Pages and tables of the documents, the numbers in them, and their code with its tasks on the CPU."""

import re

import torch
from support.scripts import ROOT

from legged_torque.envs import task_registry
from legged_torque.utils.options import Options

DOCS = ROOT / "docs"
TASKS = {
    "PD": "a1_position",
    "default torque": "a1_torque",
    "gravity pre-training": "a1_torque_gravity",
    "torque curriculum": "a1_torque_curriculum",
    "torque multi-head": "a1_torque_multihead",
    "multi-head": "a1_multihead",
    "curriculum, torque multi-head": "a1_torque_curriculum_multihead",
}
METRICS = ["track_percentage", "track_xy", "track_angular", "cost_of_transport"]


def text_of(page, heading):
    """A page from a heading on, in one line."""
    return " ".join((DOCS / page).read_text("utf-8").partition(heading)[2].split())


def rows_of(page, header):
    """Columns and rows of the table of a page that begins with a header, as lists of texts."""
    lines = (DOCS / page).read_text("utf-8").splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith(f"| {header} |"))
    end = next(i for i in range(start, len(lines)) if not lines[i].startswith("|"))
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[start:end]]
    return cells[0], cells[2:]


def same(text, value):
    """Whether a number is a value, rounded."""
    return abs(float(text) - value) <= 0.5 * 10.0 ** -len(text.partition(".")[2]) + 1e-9


def iqm(values):
    """Interquartile mean: without a quarter of the values, rounded down, at each end."""
    out = len(values) // 4
    return values.sort_values().iloc[out : len(values) - out].mean()


def fences(page):
    """Each Bash and Python block of a page: line, why it is not run if it is marked so, language, text."""
    text = (ROOT / page).read_text("utf-8")
    pattern = r"^(?:<!-- not run: (\S[^\n]*) -->\n)?```(bash|python)\n(.*?)^```"
    found = re.finditer(pattern, text, flags=re.MULTILINE | re.DOTALL)
    return [(text.count("\n", 0, match.start(2)) + 1, match[1] or "", match[2], match[3]) for match in found]


def python_files(page):
    """A page's files of Python that are run, a block each: name, given in the first line or made up, and text."""
    texts = [block for _, mark, language, block in fences(page) if language == "python" and not mark]
    texts = ["\n".join(texts)] if page == "docs/howto/python.md" else texts  # a program, as it says
    names = [re.match(r"# (\w+)\.py\n", text) for text in texts]
    made_up = (f"block_{i}_of_a_page" for i in range(len(texts)))
    return [(name[1] if name else other, text) for name, other, text in zip(names, made_up, texts, strict=True)]


def make(name, *settings, num_envs=4):
    """Build a task of a page on the CPU."""
    torch.manual_seed(0)
    options = Options(device="cpu", num_envs=num_envs, set=list(settings))
    return task_registry.make_env(name, options)[0]


def train(task, name):
    """Train a task for two short iterations."""
    settings = ["runner.num_steps_per_env=4", "evaluation.interval=0", "actor.hidden_dims=[16, 16]"]
    _, train_cfg = task_registry.get_cfgs(name, Options(device="cpu", set=settings))
    runner, _ = task_registry.make_alg_runner(task, name, train_cfg=train_cfg, log_root=None)
    before = [parameter.clone() for parameter in runner.alg.actor.parameters()]
    runner.learn(2)
    after = list(runner.alg.actor.parameters())
    assert all(torch.isfinite(parameter).all() for parameter in after)
    assert any(not torch.equal(*pair) for pair in zip(before, after, strict=True))
