"""Robots as others publish them: a URDF, a plain MJCF and one in the manner of MuJoCo Menagerie."""

LINK = """
  <link name="{name}">
    <inertial><origin xyz="{com}"/><mass value="{mass}"/>
      <inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="{com}"/><geometry>{shape}</geometry></collision>
  </link>"""
JOINT = """
  <joint name="{leg}_{part}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{pos}"/>
    <axis xyz="{axis}"/><limit effort="20" velocity="15" lower="{low}" upper="{high}"/></joint>"""
TRANSMISSION = """
  <transmission name="{leg}_{part}_t"><type>transmission_interface/SimpleTransmission</type>
    <joint name="{leg}_{part}"/><actuator name="{leg}_{part}_m"><mechanicalReduction>1</mechanicalReduction></actuator>
  </transmission>"""


def urdf(mesh="base.stl"):
    """A quadruped as vendors write them: fixed feet and an IMU, cylinders, a mesh that is not there, transmissions."""
    parts = [
        LINK.format(name="base", com="0 0 0", mass=6, i=0.06, shape=f'<mesh filename="package://dog/{mesh}"/>'),
        '<link name="imu"><inertial><mass value="0.001"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/>'
        '</inertial></link><joint name="imu_joint" type="fixed"><parent link="base"/><child link="imu"/></joint>',
    ]
    for leg, x, y in (("LF", 0.2, 0.1), ("RF", 0.2, -0.1), ("LH", -0.2, 0.1), ("RH", -0.2, -0.1)):
        rod = '<cylinder radius="0.02" length="0.2"/>'
        box = '<box size="0.05 0.05 0.05"/>'
        ball = '<sphere radius="0.025"/>'
        links = (("hip", "0 0 0", 0.5, box), ("thigh", "0 0 -0.1", 0.8, rod), ("shank", "0 0 -0.1", 0.2, rod))
        parts += [LINK.format(name=f"{leg}_{n}", com=c, mass=m, i=0.004, shape=s) for n, c, m, s in links]
        parts.append(LINK.format(name=f"{leg}_foot", com="0 0 0", mass=0.05, i=1e-5, shape=ball))
        side = 0.05 if y > 0 else -0.05
        for part, parent, child, pos, axis, low, high in (
            ("HAA", "base", f"{leg}_hip", f"{x} {y} 0", "1 0 0", -0.8, 0.8),
            ("HFE", f"{leg}_hip", f"{leg}_thigh", f"0 {side} 0", "0 1 0", -1.0, 3.0),
            ("KFE", f"{leg}_thigh", f"{leg}_shank", "0 0 -0.2", "0 1 0", -2.6, -0.5),
        ):
            names = {"leg": leg, "part": part, "parent": parent, "child": child, "kind": "revolute"}
            parts.append(JOINT.format(pos=pos, axis=axis, low=low, high=high, **names))
            parts.append(TRANSMISSION.format(**names))
        fixed = {"kind": "fixed", "parent": f"{leg}_shank", "child": f"{leg}_foot"}
        parts.append(JOINT.format(leg=leg, part="end", pos="0 0 -0.2", axis="0 0 1", low=0, high=0, **fixed))
    return f'<robot name="dog">{"".join(parts)}\n</robot>'


def as_mjcf(text):
    """A file in which motors are in another order than joints, limits are ctrlrange, one joint has a servo."""
    head = '<mujoco><compiler angle="radian"/><worldbody><body name="base" pos="0 0 1"><freejoint/>'
    body = '<geom type="box" size="0.2 0.1 0.05" mass="5"/>'
    motors = []
    for leg, x, y in (("FL", 0.2, 0.1), ("FR", 0.2, -0.1), ("RL", -0.2, 0.1), ("RR", -0.2, -0.1)):
        body += (
            f'<body name="{leg}_thigh" pos="{x} {y} 0"><joint name="{leg}_thigh" axis="0 1 0" range="-1 3"/>'
            f'<geom type="cylinder" size="0.02 0.09" pos="0 0 -0.1" mass="0.6"/><body name="{leg}_calf" pos="0 0 -0.2">'
            f'<joint name="{leg}_calf" axis="0 1 0" range="-2.6 -0.4"/>'
            '<geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.15" mass="0.2"/>'
            '<geom type="sphere" size="0.02" pos="0 0 -0.2" mass="0.05"/></body></body>'
        )
        motors.insert(0, f'<motor joint="{leg}_calf" ctrlrange="-3 3" gear="6" ctrllimited="true"/>')
        motors.insert(0, f'<position joint="{leg}_thigh" kp="80" forcerange="-12 12" forcelimited="true"/>')
    return f"{head}{body}</body></worldbody><actuator>{''.join(motors)}</actuator>{text}</mujoco>"


def as_menagerie():
    """A file in the manner of MuJoCo Menagerie.

    It has default classes, visual and collision geoms in groups of their own, visual meshes that are not there, servos
    in another order than joints, damping for those servos, excluded contacts, a site, sensors, and a keyframe.
    """
    legs, servos, excluded, pose = [], [], [], "0 0.9 -1.8 " * 4
    for leg, x, y in (("FL", 0.19, 0.05), ("FR", 0.19, -0.05), ("RL", -0.19, 0.05), ("RR", -0.19, -0.05)):
        side = 0.09 if y > 0 else -0.09
        legs.append(f"""
      <body name="{leg}_hip" pos="{x} {y} 0">
        <inertial pos="0 0 0" mass="0.6" diaginertia="0.0007 0.0006 0.0004"/>
        <joint class="abduction" name="{leg}_hip_joint"/>
        <geom class="visual" mesh="hip"/>
        <geom class="collision" size="0.045 0.02" pos="0 {side} 0" quat="1 1 0 0" type="cylinder"/>
        <body name="{leg}_thigh" pos="0 {side} 0">
          <inertial pos="0 0 -0.03" mass="1" diaginertia="0.005 0.005 0.0009"/>
          <joint class="hip" name="{leg}_thigh_joint"/>
          <geom class="collision" size="0.015 0.09" pos="0 0 -0.1"/>
          <body name="{leg}_calf" pos="0 0 -0.21">
            <inertial pos="0 0 -0.12" mass="0.2" diaginertia="0.0015 0.0015 0.00005"/>
            <joint class="knee" name="{leg}_calf_joint"/>
            <geom class="collision" size="0.012 0.07" pos="0 0 -0.09"/>
            <geom name="{leg}" class="foot"/>
            <site name="{leg}_toe" pos="0 0 -0.21"/>
          </body>
        </body>
      </body>""")
        for kind, part in (("knee", "calf"), ("hip", "thigh"), ("abduction", "hip")):
            servos.insert(0, f'<general class="{kind}" name="{leg}_{part}" joint="{leg}_{part}_joint"/>')
        excluded.append(f'<exclude body1="base" body2="{leg}_thigh"/>')
    return f"""<mujoco model="dog"><compiler angle="radian" meshdir="assets" autolimits="true"/>
  <option cone="elliptic" impratio="100"/>
  <default><default class="dog">
    <geom friction="0.6" margin="0.001" condim="1"/>
    <joint axis="0 1 0" damping="1" armature="0.01" frictionloss="0.2"/>
    <general forcerange="-24 24" biastype="affine" gainprm="50 0 0" biasprm="0 -50 -0.5"/>
    <default class="abduction"><joint axis="1 0 0" range="-0.9 0.9"/><general ctrlrange="-0.9 0.9"/></default>
    <default class="hip"><joint range="-0.7 4.5"/><general ctrlrange="-0.7 4.5"/></default>
    <default class="knee"><joint range="-2.8 -0.9"/><general ctrlrange="-2.8 -0.9" forcerange="-36 36"/></default>
    <default class="visual"><geom type="mesh" contype="0" conaffinity="0" group="2"/></default>
    <default class="collision"><geom group="3" type="capsule"/>
      <default class="foot"><geom type="sphere" size="0.022" pos="0 0 -0.21" priority="1" condim="6"/></default>
    </default>
  </default></default>
  <asset><mesh class="dog" file="hip.stl"/><material name="black"/></asset>
  <worldbody><light name="spotlight" pos="0 0 3"/>
    <body name="base" pos="0 0 0.45" childclass="dog"><freejoint/><camera name="tracking" pos="2 0 1"/>
      <inertial pos="0.02 0 0" mass="5" diaginertia="0.07 0.06 0.02"/>
      <geom class="collision" type="box" size="0.18 0.05 0.05"/><site name="imu"/>{"".join(legs)}
    </body></worldbody>
  <contact>{"".join(excluded)}</contact><actuator>{"".join(servos)}</actuator>
  <sensor><gyro site="imu"/></sensor>
  <keyframe><key name="home" qpos="0 0 0.27 1 0 0 0 {pose}" ctrl="{pose}"/></keyframe></mujoco>"""
