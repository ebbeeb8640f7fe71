"""Table I of *Learning torque control for quadrupeds* (Schmidt, Gaumann, Bohlinger), as printed.

Each value is the mean, over four runs with different seeds, of all evaluations after training step 90 million (the
table's caption). The table prints no standard errors or deviations, and has no row for default torque control
(``a1_torque``) or gravity pre-training. The paper marks significantly superior values in bold, which the text that we
have does not show; the test behind the marks is not named.

The paper names no units; those of :mod:`legged_torque.utils.metrics` are ours. "Track %" is printed as a share
(0.76, not 76), and is "Tracking" in our tables. "Track xy" and "Track angular" are squared deviations (section IV-F),
cost of transport has no unit. Collision forces fit newtons: a standing A1 presses on the ground with 122 N.
"""

ENVIRONMENTS = {
    "low": "Low perturbation",
    "high": "High perturbation",
    "high_frequency": "High perturbation & frequency",
    "doubled": "Doubled high perturbation & frequency",
}
"""The columns of Table I, in its order, by the names of our perturbations."""
MODELS = {
    "a1_position": "PD",
    "a1_torque": "Default torque",
    "a1_torque_gravity": "Gravity pre-training",
    "a1_torque_curriculum": "Torque curriculum",
    "a1_torque_multihead": "Torque multi-head",
    "a1_multihead": "Multi-head",
    "a1_torque_curriculum_multihead": "Curriculum, torque multi-head",
    "a1_torque_gravity_curriculum": "Gravity, curriculum",
    "a1_torque_gravity_multihead": "Gravity, torque multi-head",
    "a1_torque_curriculum_high": "Curriculum, higher pose",
    "a1_multihead_two_rates": "Multi-head, two rates",
}
"""Names of our tasks: the paper's, and of its future work. Default torque occurs only in its Figures 3 and 5."""
MODELS |= {
    f"a1_rough_{task.removeprefix('a1_')}{suffix}": f"{name}, {seen}"
    for task, name in list(MODELS.items())
    for suffix, seen in (("", "blind"), ("_scan", "scan"))
}  # those on rough ground
TABLE_I = {
    ("track_percentage", "a1_position"): (0.7642, 0.7518, 0.7163, 0.6765),
    ("track_percentage", "a1_torque_multihead"): (0.7624, 0.7534, 0.7159, 0.6699),
    ("track_percentage", "a1_multihead"): (0.7669, 0.7511, 0.7181, 0.6739),
    ("track_percentage", "a1_torque_curriculum"): (0.7866, 0.7700, 0.7197, 0.6764),
    ("track_xy", "a1_position"): (0.0324, 0.0511, 0.0933, 0.1602),
    ("track_xy", "a1_torque_multihead"): (0.0350, 0.0556, 0.0997, 0.1685),
    ("track_xy", "a1_multihead"): (0.0344, 0.0544, 0.0970, 0.1698),
    ("track_xy", "a1_torque_curriculum"): (0.0316, 0.0534, 0.0972, 0.1697),
    ("track_angular", "a1_position"): (0.0124, 0.0122, 0.0152, 0.0171),
    ("track_angular", "a1_torque_multihead"): (0.0110, 0.0113, 0.0138, 0.0158),
    ("track_angular", "a1_multihead"): (0.0102, 0.0113, 0.0133, 0.0156),
    ("track_angular", "a1_torque_curriculum"): (0.0097, 0.0111, 0.0143, 0.0177),
    ("collision_force", "a1_position"): (135.1, 131.7, 138.5, 148.7),
    ("collision_force", "a1_torque_multihead"): (140.9, 145.5, 157.3, 166.8),
    ("collision_force", "a1_multihead"): (139.0, 142.0, 153.5, 160.1),
    ("collision_force", "a1_torque_curriculum"): (136.0, 134.7, 150.5, 151.9),
    ("cost_of_transport", "a1_position"): (0.8316, 0.8518, 0.9728, 1.0340),
    ("cost_of_transport", "a1_torque_multihead"): (0.7187, 0.7307, 0.8380, 0.8808),
    ("cost_of_transport", "a1_multihead"): (0.6977, 0.7209, 0.8029, 0.8611),
    ("cost_of_transport", "a1_torque_curriculum"): (0.8590, 0.9112, 0.9572, 1.0373),
}
"""Means by metric and task, one for each of :data:`ENVIRONMENTS`."""

PAPER_TASKS = tuple(dict.fromkeys(task for _, task in TABLE_I))
"""The tasks of Table I."""


def task_on_plane(task: str) -> str:
    """Return the name of the task with the same approach on a plane."""
    return task.replace("_rough_", "_", 1).removesuffix("_scan")


def paper_value(task: str, environment: str, metric: str) -> float | None:
    """Return a mean of Table I; None if the paper has none."""
    return dict(zip(ENVIRONMENTS, TABLE_I.get((metric, task), ()), strict=False)).get(environment)
