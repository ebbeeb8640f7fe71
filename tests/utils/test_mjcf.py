"""Chains of bodies, and poses that are held under PD control, of small robots in MJCF."""

import mujoco
import numpy as np
import pytest

from legged_torque.utils.errors import UserError
from legged_torque.utils.mjcf import body_chains, colliding_pairs, exclude_self_collisions, hang_up
from legged_torque.utils.standing import hold_pose


def tree(text):
    """The model of a tree of bodies with hinges: each letter a body, its children in parentheses behind it."""
    parts = []
    for letter in text:
        geom = f'<geom name="{letter}" size="0.05"/><joint axis="0 1 0"/>'
        parts.append({"(": "", ")": "</body>"}.get(letter, f'<body name="{letter}" pos="0 0 -0.2">{geom}'))
    body = "".join(parts).replace('<joint axis="0 1 0"/>', "<freejoint/>", 1)
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</body></worldbody></mujoco>")


@pytest.mark.parametrize(
    ("text", "chains"),
    [("t", []), ("ta)b)", ["a", "b"]), ("ta(b(c)))d(e))", ["abc", "de"]), ("ts(a(b))c(d)))e)", ["sab", "scd", "e"])],
)
def test_body_chains(text, chains):
    """There is a chain for each end of the tree, in the file's order; chains share bodies above a branch."""
    model = tree(text)
    assert ["".join(model.body(body).name for body in chain) for chain in body_chains(model)] == chains


@pytest.mark.parametrize(("flag", "pairs"), [("enable", [[0, 2]]), ("disable", [[0, 1], [0, 2], [1, 2]])])
def test_parents_and_children(flag, pairs):
    """They may touch if the file switches the filter of parents off, until they are excluded; MuJoCo agrees."""
    ends = "<joint/><geom/></body>"
    body = f"<body><freejoint/><geom/><body>{ends[:-7]}<body>{ends}</body></body>"
    option = f'<option><flag filterparent="{flag}"/></option><default><geom size="0.1"/></default>'
    spec = mujoco.MjSpec.from_string(f"<mujoco>{option}<worldbody>{body}</worldbody></mujoco>")
    for expected in (pairs, []):
        data = mujoco.MjData(spec.compile())
        mujoco.mj_forward(data.model, data)
        assert colliding_pairs(data.model).tolist() == expected == sorted(data.contact.geom.tolist())
        exclude_self_collisions(spec, data.model)


def test_a_robot_that_hangs():
    """It touches nothing, not even by a <pair> of parts that overlap."""
    parts = '<geom name="{0}" size="0.1"/>'
    body = f"<body><freejoint/>{parts.format('a')}<body><joint/>{parts.format('b')}</body></body>"
    floor, pair = '<geom type="plane" size="1 1 1"/>', '<contact><pair geom1="a" geom2="b"/></contact>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{floor}{body}</worldbody>{pair}</mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 3
    hang_up(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0


TABLE = """<mujoco><option timestep="0.002"/><worldbody><geom name="floor" type="plane" size="0 0 1"/>
  <body name="top" pos="0 0 0.55"><freejoint/><geom name="top" type="box" size="0.3 0.2 0.02" mass="5"/>{}</body>
</worldbody><actuator>{}</actuator></mujoco>"""
LEG = """<body pos="{x} {y} 0"><joint name="{x} {y}" axis="0 1 0"/>
  <geom name="leg {x} {y}" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" mass="0.5"/></body>"""
MOTOR = '<motor joint="{x} {y}"/>'


def table(places):
    """A table at rest on legs below some places, with a motor in each hip."""
    legs, motors = ("".join(part.format(x=x, y=y) for x, y in places) for part in (LEG, MOTOR))
    return mujoco.MjData(mujoco.MjModel.from_xml_string(TABLE.format(legs, motors)))


CORNERS = [(0.25, 0.15), (0.25, -0.15), (-0.25, 0.15), (-0.25, -0.15)]


@pytest.mark.parametrize(
    ("places", "stiffness", "limit", "fall"),
    [
        (CORNERS, 200.0, 50.0, ""),
        (CORNERS, 200.0, 0.01, "the trunk has sunk from 0.55 to 0.2"),
        (CORNERS[:2], 200.0, 50.0, "the trunk is tilted by 0.5"),
    ],
)
def test_hold_pose(places, stiffness, limit, fall):
    """A table stands on four stiff legs; with weak motors it sinks down, on two legs it tips over."""
    data, joints = table(places), np.ones(len(places))
    data.qvel[0] = 0.05
    limits = np.array([-limit * joints, limit * joints])
    result = hold_pose(data, stiffness * joints, 2.0 * joints, limits, 3.0)
    assert fall in result.fall and bool(fall) == bool(result.fall)
    assert str(result).startswith(f"IT FELL after {data.time:.2f} s {fall}" if fall else "it stands: trunk at 0.5")
    assert (result.height, result.nominal) == (data.qpos[2], 0.55)
    assert result.saturated > 0.9 if limit < 1.0 else result.saturated == 0.0
    assert (result.error < 0.1 and result.drift < 0.1) or fall


def test_parts_that_may_not_touch():
    """The contact of a chosen geom is a fall."""
    data, joints = table(CORNERS), np.ones(4)
    leg = data.model.geom("leg -0.25 0.15").id
    data.qpos[2] -= 0.03
    result = hold_pose(data, 200.0 * joints, 2.0 * joints, np.array([-joints, joints]), 1.0, may_not_touch=[leg])
    assert result.fall.endswith("'leg -0.25 0.15' touches the ground")


def test_divergence():
    """Gains too high for the time step are an error, without a warning of MuJoCo's."""
    data, joints = table(CORNERS), np.ones(4)
    limits = np.array([-1e9 * joints, 1e9 * joints])
    with pytest.raises(UserError, match="the simulation diverges under PD control: check masses, gains"):
        hold_pose(data, 1e7 * joints, 1e5 * joints, limits, 1.0)
