"""Robots in MJCF files: MuJoCo's complaints in one line, chains of bodies, motors by transmission, colliding parts."""

import contextlib
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np

from legged_torque.utils.errors import UserError

DRAWN_GROUPS = (0, 1, 2)  # of geoms that videos and viewers draw
HELD = 1e6  # [kg] and [kg m^2] of a trunk that is held


@contextlib.contextmanager
def loading(file: str | Path) -> Iterator[None]:
    """Turn MuJoCo's errors and warnings inside into a UserError that names the MJCF file."""
    if not Path(file).is_file():
        raise UserError(f"cannot load the robot '{file}': there is no such file")
    with kept_warnings() as messages, warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            yield
        except (ValueError, mujoco.FatalError, UserWarning) as error:
            messages.append(str(error))
    if messages:
        raise UserError(f"cannot load the robot '{file}': {' '.join(messages[0].split())}")


@contextlib.contextmanager
def kept_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings inside instead of printing them and logging them to a file in the current folder."""
    messages: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(messages.append)
    try:
        yield messages
    finally:
        mujoco.set_mju_user_warning(before)


def read_spec(file: Path, joints: Sequence[str] = ()) -> mujoco.MjSpec:
    """Read a MJCF file and put its joints in the order of ``joints`` if moving whole limbs does it; else keep theirs.

    Keyframes are in the file's order, so they are dropped where limbs are moved. A UserError if the file is missing or
    cannot be read.
    """
    with loading(file):
        spec = mujoco.MjSpec.from_file(str(file))
        names = [joint.name for joint in spec.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE]
        if names == list(joints) or sorted(names) != sorted(joints):
            return spec
        root = ElementTree.parse(file).getroot()
        if root.find(".//include") is not None:
            return spec
        ranks = {name: rank for rank, name in enumerate(joints)}

        def first_joint(part: ElementTree.Element) -> int:
            below = part.iter("joint") if part.tag in ("body", "frame") else ()
            return min((ranks.get(joint.get("name", ""), -1) for joint in below), default=-1)

        for parent in root.findall("worldbody//*"):
            parent[:] = sorted(parent, key=first_joint)
        for keyframe in root.findall("keyframe"):
            root.remove(keyframe)
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        spec.modelfiledir = str(Path(file).absolute().parent)
        return spec


def body_chains(model: mujoco.MjModel) -> list[list[int]]:
    """Return the bodies from the trunk's children, the trunk being body 1, to each end of the tree, in their order."""
    parents, chains = model.body_parentid.tolist(), []
    for end in sorted(set(range(2, model.nbody)) - set(parents)):
        chain = [end]
        while parents[chain[0]] > 1:
            chain.insert(0, parents[chain[0]])
        if parents[chain[0]] == 1:
            chains.append(chain)
    return chains


def motors_of(model: mujoco.MjModel, joint: int) -> list[int]:
    """Return the actuators that act on a joint, by their transmission."""
    on_joint = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_trnid[:, 0] == joint)
    return np.flatnonzero(on_joint).tolist()


def why_no_motor(model: mujoco.MjModel, actuator: int) -> str:
    """Return why an actuator's control is not proportional to the torque of a joint; empty if it is."""
    if model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_JOINT:
        return "does not act on a joint"
    if model.actuator_gaintype[actuator] != mujoco.mjtGain.mjGAIN_FIXED:
        return "has a gain that is not fixed"
    if model.actuator_biastype[actuator] != mujoco.mjtBias.mjBIAS_NONE:
        return "is a servo, whose control is a target: import_robot.py reads it as a motor"
    if model.actuator_dyntype[actuator] != mujoco.mjtDyn.mjDYN_NONE:
        return "has dynamics of its own"
    if not torque_per_control(model, actuator):
        return "has a gear or gain of 0"
    extras = ("actuator_delay", "actuator_damping", "actuator_dampingpoly", "actuator_armature")  # not in all versions
    found = [name for name in extras if np.any(getattr(model, name, np.zeros(model.nu))[actuator])]
    return f"has {', '.join(name.removeprefix('actuator_') for name in found)}" if found else ""


def torque_per_control(model: mujoco.MjModel, motor: int) -> float:
    """Return the torque of a motor per unit of its control [N m]."""
    return float(model.actuator_gainprm[motor, 0] * model.actuator_gear[motor, 0])


def torque_range(model: mujoco.MjModel, motor: int) -> tuple[float, float]:
    """Return the lowest and highest torque of a motor on its joint [N m]: the tightest of all limits.

    These are its forcerange times gear, its ctrlrange times gear and gain, and its joint's actuatorfrcrange.
    """
    joint, gear = model.actuator_trnid[motor, 0], model.actuator_gear[motor, 0]
    ranges = (
        (model.actuator_ctrllimited[motor], model.actuator_ctrlrange[motor] * torque_per_control(model, motor)),
        (model.actuator_forcelimited[motor], model.actuator_forcerange[motor] * gear),
        (model.jnt_actfrclimited[joint], model.jnt_actfrcrange[joint]),
    )
    limits = [limits for is_limited, limits in ranges if is_limited] or [np.array([-np.inf, np.inf])]
    return max(float(each.min()) for each in limits), min(float(each.max()) for each in limits)


def joint_axes(model: mujoco.MjModel) -> np.ndarray:
    """Return the axes of all joints in the frame of a level trunk, all angles being 0. Shape: (njnt, 3)."""
    return zero_pose(model).xaxis.copy()


def zero_pose(model: mujoco.MjModel, joints: np.ndarray | None = None) -> mujoco.MjData:
    """Return the state with the trunk level at the origin and these angles [rad] of the joints (default: 0)."""
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    data.qpos[model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE] + 3] = 1.0
    if joints is not None:
        data.qpos[7:] = joints
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data


def robot_notes(file: Path, trained: Path) -> Iterator[str]:
    """Yield differences of axes and mass between the robot of a MJCF and the robot that a policy was trained on."""
    if not trained.is_file():
        yield f"asset.file is not compared with that of the training, '{trained}', which is gone"
        return
    models = []
    for each in (file, trained):
        with loading(each):
            models.append(read_spec(each).compile())
    ours, theirs = ({m.joint(i).name: axis for i, axis in enumerate(joint_axes(m))} for m in models)
    if turned := ", ".join(name for name, axis in theirs.items() if name in ours and axis @ ours[name] < 0.999):
        yield f"asset.file has other axes than the robot of the training: {turned} are seen and driven wrongly"
    masses = [float(model.body_mass.sum()) for model in models]
    if abs(masses[0] - masses[1]) > 1e-3 * masses[1]:
        yield f"asset.file has {masses[0]:.3f} kg, the robot of the training {masses[1]:.3f} kg"


def mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the mass matrix of a state whose kinematics are known. Shape: (nv, nv)."""
    mujoco.mj_crb(model, data)
    matrix = np.zeros((model.nv, model.nv))
    for row, unit in zip(matrix, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    return matrix


def joint_limits(model: mujoco.MjModel) -> np.ndarray:
    """Return lowest and highest position of each joint, infinite without a range. Shape: (njnt, 2) [rad]."""
    return np.where(model.jnt_limited[:, np.newaxis] > 0, model.jnt_range, [-np.inf, np.inf])


def set_joints(model: mujoco.MjModel, values: Mapping[str, Mapping[str, float]]) -> None:
    """Give joints other armatures [kg m^2], dampings [N m s/rad] or friction losses [N m], by field and name."""
    for field, of_joints in values.items():
        for name, value in of_joints.items():
            getattr(model, f"dof_{field}")[model.joint(name).dofadr[0]] = value
    if values:
        mujoco.mj_setConst(model, mujoco.MjData(model))


def hang_up(model: mujoco.MjModel) -> None:
    """Give a model a trunk so heavy that legs do not move it, and no contacts; a force has to carry its weight."""
    inertia = float(model.stat.meaninertia)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.body_mass[1], model.body_inertia[1], model.body_ipos[1] = HELD, HELD, 0.0
    mujoco.mj_setConst(model, mujoco.MjData(model))
    model.stat.meaninertia = inertia  # by which solvers judge their progress


def drawing_notes(spec: mujoco.MjSpec) -> Iterator[str]:
    """Yield advice if views draw nothing of the robot, because all its geoms are in hidden groups."""
    robot = [geom for geom in spec.geoms if geom.parent.name != "world"]
    if robot and not any(geom.group in DRAWN_GROUPS for geom in robot):
        groups = ", ".join(sorted({str(geom.group) for geom in robot}))
        yield f"no view draws the robot: its geoms are in group {groups}; put those to be seen into group 0, 1 or 2"


def colliding_pairs(model: mujoco.MjModel) -> np.ndarray:
    """Return the pairs of geoms that may touch, as MuJoCo filters them. Shape: (pairs, 2).

    Their ``contype`` and ``conaffinity`` match, and their bodies are neither the same, nor parent and child (if
    the model filters these), nor excluded; or they are a ``<pair>``. None if the model disables contacts.
    """
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT:
        return np.empty((0, 2), int)
    first, second = np.triu_indices(model.ngeom, k=1)
    bodies = model.geom_bodyid[[first, second]]
    welds = model.body_weldid[bodies]  # bodies without joints are parts of their parents
    parents = model.body_weldid[model.body_parentid[welds]]
    filters = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    related = filters & (welds > 0).all(axis=0) & (welds == parents[::-1]).any(axis=0)
    family = (welds[0] == welds[1]) | related
    excluded = np.isin((bodies[0] << 16) + bodies[1], model.exclude_signature)
    types, affinities = model.geom_contype, model.geom_conaffinity
    meet = (types[first] & affinities[second]) | (types[second] & affinities[first])
    chosen = np.stack([first, second], axis=1)[(meet != 0) & ~family & ~excluded]
    named = np.sort(np.stack([model.pair_geom1, model.pair_geom2], axis=1), axis=1)
    return np.unique(np.concatenate([chosen, named]), axis=0)


def self_pairs(model: mujoco.MjModel) -> np.ndarray:
    """Return those of :func:`colliding_pairs` whose geoms are both parts of the same robot. Shape: (pairs, 2)."""
    pairs = colliding_pairs(model)
    bodies = model.geom_bodyid[pairs]
    roots, moving = model.body_rootid[bodies], model.body_weldid[bodies] > 0
    return pairs[(roots[:, 0] == roots[:, 1]) & moving.all(axis=1)]


def exclude_self_collisions(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Exclude all contacts between parts of a robot in ``spec``, of which ``model`` was compiled."""
    pairs = self_pairs(model)
    bodies = {body.id: body for body in spec.bodies}
    for first, second in np.unique(model.geom_bodyid[pairs], axis=0).tolist():
        for body in (first, second):
            bodies[body].name = bodies[body].name or f"body {body}"
        spec.add_exclude(bodyname1=bodies[first].name, bodyname2=bodies[second].name)
    unwanted = {frozenset(model.geom(geom).name for geom in pair) for pair in pairs.tolist()}
    for pair in list(spec.pairs):
        if {pair.geomname1, pair.geomname2} in unwanted:
            spec.delete(pair)
