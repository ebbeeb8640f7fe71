"""Settings of runs of commit d8439d6, in today's layout: random parameters had a setting per operation."""

from typing import Any

_RANGES = {
    "trunk_mass": {"add": "trunk_mass_offset", "scale": "trunk_mass_scale"},
    "trunk_com": {"add": "trunk_com_offset"},
    "foot_radius": {"set": "foot_radius", "scale": "foot_radius_share"},
    "foot_pos": {"add": "foot_offset"},
    "dof_damping": {"set": "dof_damping", "add": "dof_damping_share"},
    "dof_armature": {"set": "dof_armature", "scale": "dof_armature_share"},
    "dof_stiffness": {"set": "dof_stiffness", "add": "dof_stiffness_share"},
    "dof_frictionloss": {"set": "dof_frictionloss", "add": "dof_frictionloss_share"},
    **{name: {"set": name} for name in ("ground_friction", "contact_stiffness", "contact_damping", "gravity")},
    "motor_strength": {"scale": "motor_strength", "scale_per_joint": "motor_strength_per_joint"},
    "joint_offset": {"add": "joint_offset"},
    "action_scale": {"add": "action_scale_offset"},
    **{
        name: {"add": f"{name}_offset", "scale": f"{name}_scale", "scale_per_joint": f"{name}_scale_per_joint"}
        for name in ("stiffness", "damping")
    },
}
"""The old settings of each parameter, by operation."""


def is_older(values: dict[str, Any]) -> bool:
    """Return whether settings of a task, as nested dictionaries, are of such a run."""
    return isinstance(values.get("domain_rand"), dict) and "trunk_mass_offset" in values["domain_rand"]


def converted(values: dict[str, Any]) -> dict[str, Any]:
    """Return settings of such a run in today's layout; a user's own settings stay as they are."""
    rand, motors = dict(values["domain_rand"]), dict(values.get("motors", {}))
    fixed = rand.pop("keep_fixed", [])
    delay = {"range": rand.pop("action_delay", [0, 0]), "unit": rand.pop("action_delay_unit", "physics_steps")}
    draws = {name: _ranges(rand, names, fixed) for name, names in _RANGES.items()}
    for names in _RANGES.values():
        for name in names.values():
            rand.pop(name, None)
    motors.pop("model", None)
    return {**values, "domain_rand": {**rand, **draws, "keep_fixed": []}, "motors": {**motors, "delay": delay}}


def _ranges(rand: dict[str, Any], names: dict[str, str], fixed: list[str]) -> dict[str, list[float]]:
    """Return the ranges of a parameter by operation. Ranges that were kept fixed are left out.

    A share counted where the number itself had no range. Factors per joint are listed for the critic in any case.
    """
    kept = {operation: name for operation, name in names.items() if rand.get(name) is not None}
    if "set" in kept:
        kept = {"set": kept["set"]}
    ranges = {
        operation: rand[name]
        for operation, name in kept.items()
        if not {name, name.removesuffix("_share")} & set(fixed)
    }
    if "scale_per_joint" in kept:
        ranges.setdefault("scale_per_joint", [1.0, 1.0])
    return ranges
