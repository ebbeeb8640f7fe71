"""Settings of runs of commit d8439d6, in today's layout."""

from support.settings import error_of, get_cfgs

from legged_torque.envs.base.older_runs import converted, is_older
from legged_torque.utils.config import to_dict

A1 = {
    "init_roll": [-0.2, 0.2],
    "action_delay": [0, 6],
    "action_delay_unit": "physics_steps",
    "randomize_parameters": True,
    "keep_fixed": ["gravity", "foot_radius", "motor_strength_per_joint"],
    "resampling_probability": 0.002,
    "trunk_mass_offset": [-1.0, 1.0],
    "trunk_mass_scale": [1.0, 1.0],
    "trunk_com_offset": [-0.003, 0.003],
    "foot_radius": [0.019, 0.021],
    "foot_radius_share": [0.95, 1.05],
    "foot_offset": [-0.0025, 0.0025],
    "keep_probability": 0.0,
    "dof_damping": [0.0, 0.2],
    "dof_damping_share": [0.0, 0.4],
    "dof_armature": None,
    "dof_armature_share": [0.8, 2.0],
    "dof_stiffness": None,
    "dof_stiffness_share": None,
    "dof_frictionloss": None,
    "dof_frictionloss_share": [0.0, 0.012],
    "ground_friction": [0.8, 1.2],
    "contact_stiffness": [900.0, 1100.0],
    "contact_damping": [72.0, 88.0],
    "gravity": [9.51, 10.11],
    "motor_strength": [0.9, 1.1],
    "motor_strength_per_joint": [0.98, 1.02],
    "joint_offset": [-0.01, 0.01],
    "action_scale_offset": [0.0, 0.0],
    "stiffness_offset": [0.0, 0.0],
    "stiffness_scale": [0.9, 1.1],
    "stiffness_scale_per_joint": None,
    "damping_offset": [0.0, 0.0],
    "damping_scale": [0.9, 1.1],
    "damping_scale_per_joint": [0.98, 1.02],
    "push_robots": True,
    "thigh_mass_scale": [0.8, 1.2],
}
"""``domain_rand`` of such a run, with all kinds of pairs and a setting of a user's own."""


def test_ranges():
    """Each parameter has the ranges that were drawn: shares where there was no number, none that were kept fixed."""
    values = {"domain_rand": A1, "motors": {"model": "ideal"}, "env": {"num_envs": 3}}
    assert is_older(values)
    new = converted(values)
    assert new["env"] == {"num_envs": 3}
    assert new["motors"] == {"delay": {"range": [0, 6], "unit": "physics_steps"}}
    expected = {
        "init_roll": [-0.2, 0.2],
        "randomize_parameters": True,
        "resampling_probability": 0.002,
        "keep_probability": 0.0,
        "push_robots": True,
        "thigh_mass_scale": [0.8, 1.2],
        "keep_fixed": [],
        "trunk_mass": {"add": [-1.0, 1.0], "scale": [1.0, 1.0]},
        "trunk_com": {"add": [-0.003, 0.003]},
        "foot_radius": {},
        "foot_pos": {"add": [-0.0025, 0.0025]},
        "dof_damping": {"set": [0.0, 0.2]},
        "dof_armature": {"scale": [0.8, 2.0]},
        "dof_stiffness": {},
        "dof_frictionloss": {"add": [0.0, 0.012]},
        "ground_friction": {"set": [0.8, 1.2]},
        "contact_stiffness": {"set": [900.0, 1100.0]},
        "contact_damping": {"set": [72.0, 88.0]},
        "gravity": {},
        "motor_strength": {"scale": [0.9, 1.1], "scale_per_joint": [1.0, 1.0]},  # listed for the critic, and not drawn
        "joint_offset": {"add": [-0.01, 0.01]},
        "action_scale": {"add": [0.0, 0.0]},
        "stiffness": {"add": [0.0, 0.0], "scale": [0.9, 1.1]},
        "damping": {"add": [0.0, 0.0], "scale": [0.9, 1.1], "scale_per_joint": [0.98, 1.02]},
    }
    assert new["domain_rand"] == expected


def test_a_run_is_loaded():
    """A task takes the settings of such a run, and those of today's runs as they are."""
    today = to_dict(get_cfgs("--perturbation=low")[0])
    assert not is_older(today)
    old = today | {
        "domain_rand": {k: v for k, v in A1.items() if k != "thigh_mass_scale"},
        "motors": {"model": "ideal"},
    }
    cfg = get_cfgs(run_config={"env": old, "train": {}})[0]
    assert cfg.domain_rand.dof_damping == {"set": [0.0, 0.2]} and cfg.motors.delay.range == [0, 6]
    assert to_dict(get_cfgs(run_config={"env": today, "train": {}})[0]) == today


def test_old_names_are_refused():
    """An old name on the command line is refused with the new one."""
    line = error_of(get_cfgs, "--set=domain_rand.trunk_mass_offset=[-2, 2]")
    assert "domain_rand.trunk_mass" in line
