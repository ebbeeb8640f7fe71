"""Reading somebody's MJCF or URDF: its parts as MuJoCo understands them, and what had to be told on the way."""

from __future__ import annotations

import re
import warnings
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

from legged_torque.utils.errors import UserError
from legged_torque.utils.mjcf import kept_warnings, motors_of, torque_range

MESH_TYPES = (".stl", ".obj", ".msh")  # what MuJoCo reads
VISUAL_GROUP = 3  # in which Menagerie keeps collision geoms, also those that one of its files switches off
TINY = 1e-6  # [kg m^2], [kg] what counts as no inertia or mass of a fixed link; MuJoCo refuses less
GRAVITY = 9.81  # [m/s^2], whatever the file has
NAME = re.compile(r"[A-Za-z0-9_.:/-]*")  # names of bodies and joints, which become parts of settings and of a MJCF
SITE = "link:"  # with which the names of sites begin that say where fixed links were


@dataclass
class Source:
    """A robot as its file describes it: a floating trunk, every other body with one hinge joint.

    Fixed links are part of the bodies that they are fixed to; ``sites`` keep where they were: by body, their names and
    places [m] in its frame.
    """

    file: Path
    model: mujoco.MjModel
    sites: dict[int, list[tuple[str, np.ndarray]]]
    pose: np.ndarray | None  # angles [rad] of the file's keyframe, by joint but the free one
    torque_limits: np.ndarray  # [N m] the tightest of the file, by joint; infinite without any
    speed_limits: list[float]  # [rad/s] those that an URDF has
    notes: list[str] = field(default_factory=list)  # what was changed and why, a line each

    @property
    def joints(self) -> list[str]:
        """Names of the hinge joints, in the order of the file."""
        return [self.model.joint(i).name for i in range(1, self.model.njnt)]

    def body_of(self, joint: int) -> int:
        """Return the body that a hinge joint, counted without the free one, moves."""
        return int(self.model.jnt_bodyid[joint + 1])


def read_source(file: Path) -> Source:
    """Read a MJCF or URDF; a UserError says why it cannot become a robot of this library."""
    if not file.is_file():
        raise UserError(f"cannot import '{file}': there is no such file")
    with kept_warnings(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what matters is told when the result is loaded
        try:
            root = ET.parse(file).getroot()
            _refuse_macros(root, file)
            spec = mujoco.MjSpec.from_file(str(file))
            _check_names(spec, file)
            notes = _prepare(spec, file, root.tag == "robot")
            model = _compile(spec, notes)
            speed_limits = _speed_limits(root)
        except (ValueError, ET.ParseError, mujoco.FatalError) as error:
            raise UserError(f"cannot import '{file}': {' '.join(str(error).split())}") from None
    _check(model, file)
    sites: dict[int, list] = {}
    for site in range(model.nsite):
        name = model.site(site).name.removeprefix(SITE)
        sites.setdefault(int(model.site_bodyid[site]), []).append((name, model.site_pos[site].copy()))
    pose = model.key_qpos[_home(model)][7:].copy() if model.nkey else None
    limits = _torque_limits(model, notes)
    return Source(file, model, sites, pose, limits, speed_limits, notes)


def _check_names(spec: mujoco.MjSpec, file: Path) -> None:
    """Raise a UserError that lists all names of bodies and joints that are not plain."""
    names = dict.fromkeys(part.name for part in [*spec.bodies, *spec.joints])
    odd = [repr(name) for name in names if not NAME.fullmatch(name)]
    if odd:
        raise UserError(f"cannot import '{file}': names may have letters, digits and _ . : / -, not {', '.join(odd)}")


def _prepare(spec: mujoco.MjSpec, file: Path, is_urdf: bool) -> list[str]:
    """Make a file compile to one floating robot without anything else; return what was changed."""
    notes = _find_meshes(spec, file, is_urdf)
    in_pairs = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    for part in [*spec.sensors, *spec.lights, *spec.cameras, *spec.sites, *spec.excludes, *spec.pairs]:
        spec.delete(part)
    switched_on = dict[str, None]()
    for geom in spec.geoms:
        geom.material = ""
        if is_urdf:
            geom.mass = 0.0  # links weigh what <inertial> says, those without it nothing
        if not (geom.contype or geom.conaffinity) and (geom.group == VISUAL_GROUP or geom.name in in_pairs):
            geom.conaffinity = 1
            if geom.name not in in_pairs:
                switched_on[geom.parent.name] = None
    if switched_on:
        notes.append(f"geoms of group {VISUAL_GROUP}, which the file switches off, collide: {', '.join(switched_on)}")
    for part in [*spec.materials, *spec.textures]:
        spec.delete(part)
    roots = [body for body in spec.worldbody.bodies if body.find_all("joint")]
    if len(roots) != 1:
        raise UserError(f"cannot import '{file}': {len(roots)} bodies with joints hang on the world, it must be one")
    if not roots[0].joints:
        roots[0].add_freejoint()
        notes.append(f"'{roots[0].name}' was fixed to the world; it floats now")
        for key in list(spec.keys):
            spec.delete(key)
        _drop_footprint(roots[0], notes)
    for body in spec.bodies:
        if body.name and not body.joints and body.name != "world":
            body.add_site(name=SITE + body.name)
    unnamed = [joint for joint in spec.joints if not joint.name and joint.type != mujoco.mjtJoint.mjJNT_FREE]
    for number, joint in enumerate(unnamed, 1):
        joint.name = f"{joint.parent.name or number}_joint"
        notes.append(f"the joint of '{joint.parent.name}' had no name: '{joint.name}'")
    spec.option.gravity, spec.option.disableflags = [0.0, 0.0, -GRAVITY], 0
    spec.compiler.fusestatic = True
    spec.compiler.discardvisual = True
    return notes


def _drop_footprint(root: mujoco.MjsBody, notes: list[str]) -> None:
    """Put the trunk's origin where its first real link is, below a root of a URDF that is nothing but a frame."""
    (link, *others) = root.bodies
    is_frame = not (others or root.explicitinertial or list(root.geoms))
    if is_frame and not link.joints:
        link.pos, link.quat = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]
        notes.append(f"'{root.name}' is no more than a frame: the trunk's origin is that of '{link.name}'")


def _compile(spec: mujoco.MjSpec, notes: list[str]) -> mujoco.MjModel:
    """Compile; inertias that no body can have, which MuJoCo refuses, are mended where links are fixed, and told."""
    for body in spec.bodies:
        moves = any(joint.type != mujoco.mjtJoint.mjJNT_FREE for joint in body.joints)
        if moves or not body.explicitinertial or np.isnan(body.fullinertia[0]):
            continue
        xx, yy, zz, xy, xz, yz = body.fullinertia
        if np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[0] < TINY:
            if body.mass > TINY and max(abs(xy), abs(xz), abs(yz)) > TINY:
                notes.append(f"the inertia of the fixed link '{body.name}' is none that a body can have: diagonal kept")
            body.fullinertia, body.inertia = np.full(6, np.nan), np.maximum([xx, yy, zz], TINY)
    try:
        return spec.compile()
    except ValueError as error:
        if "balanceinertia" not in str(error):
            raise
        spec.compiler.balanceinertia = True
        notes.append(f"some inertias break A + B >= C and were balanced; MuJoCo said: {' '.join(str(error).split())}")
        return spec.compile()


def _find_meshes(spec: mujoco.MjSpec, file: Path, is_urdf: bool) -> list[str]:
    """Point meshes to their files; leave those out that are nowhere near or that MuJoCo cannot read, and say so."""
    missing = {}
    for mesh in list(spec.meshes):
        if not mesh.file:
            continue
        found = _find(mesh.file, Path(file).absolute().parent, spec.meshdir)
        name = mesh.name or Path(mesh.file).stem
        if found:
            mesh.name, mesh.file = name, str(found)
        else:
            missing[name] = mesh
    spec.meshdir = ""
    lost = []
    for geom in list(spec.geoms):
        if geom.meshname in missing:
            collides = bool(geom.contype or geom.conaffinity)
            weighs = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
            if not is_urdf and (weighs or not geom.parent.explicitinertial):
                raise UserError(
                    f"cannot import '{file}': the inertia of '{geom.parent.name}' follows from the mesh "
                    f"'{missing[geom.meshname].file}', which is missing or of a type other than {', '.join(MESH_TYPES)}"
                )
            if collides:
                lost.append(geom.parent.name)
            spec.delete(geom)
    for mesh in missing.values():
        spec.delete(mesh)
    if not lost:
        return []
    links = ", ".join(dict.fromkeys(lost))
    return [f"collision meshes of {links} are missing or not {', '.join(MESH_TYPES)}: shapes follow from inertias"]


def _find(name: str, folder: Path, meshdir: str) -> Path | None:
    """Return where a mesh is: as the file says, or with the end of its path below a parent folder."""
    parts = Path(name.split("://")[-1]).parts
    roots = [folder / meshdir, folder, *list(folder.parents)[:4]]
    ends = [Path(*parts[start:]) for start in range(len(parts))]
    for path in (root / end for root in roots for end in ends):
        for kind in (path.suffix, *MESH_TYPES):
            candidate = path.with_suffix(kind)
            if candidate.suffix.lower() in MESH_TYPES and candidate.is_file():
                return candidate
    return None


def _check(model: mujoco.MjModel, file: Path) -> None:
    """Raise a UserError, with all reasons, for what is not a floating trunk and bodies with a hinge each."""
    hinge, free = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_FREE
    reasons = []
    if model.njnt < 2 or model.jnt_type[0] != free:
        reasons.append("its trunk does not float")
    others = [model.joint(i).name for i in range(1, model.njnt) if model.jnt_type[i] != hinge]
    if others:
        reasons.append(f"only hinge joints can be imported, not {', '.join(others)}")
    several = [model.body(b).name for b in range(1, model.nbody) if model.body_jntnum[b] > 1]
    if several:
        reasons.append(f"a body may have one joint, {', '.join(several)} have more")
    if model.neq:
        reasons.append(f"its {model.neq} equalities (closed loops, mimicked joints) cannot be imported")
    if model.ntendon:
        reasons.append(f"its {model.ntendon} tendons cannot be imported")
    if reasons:
        raise UserError(f"cannot import '{file}': {'; '.join(reasons)}")


def _home(model: mujoco.MjModel) -> int:
    """Return the keyframe to stand in: "home", if there is one, or the first."""
    names = [model.key(i).name for i in range(model.nkey)]
    return names.index("home") if "home" in names else 0


def _torque_limits(model: mujoco.MjModel, notes: list[str]) -> np.ndarray:
    """Return the tightest torque limit of each hinge [N m], the smaller of both directions. Adds notes."""
    for actuator in range(model.nu):
        if model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_JOINT:
            raise UserError(f"the actuator '{model.actuator(actuator).name}' does not act on a joint")
    is_servo = model.actuator_biastype != mujoco.mjtBias.mjBIAS_NONE
    model.actuator_ctrllimited[is_servo] = False  # their controls are no torques
    if is_servo.any():
        notes.append(f"{is_servo.sum()} position or velocity servos became motors; their gains are left out")
    if model.actuator_dyntype.any():
        notes.append("the dynamics of actuators (filters, activations) are left out")
    if model.body_gravcomp.any():
        notes.append("the compensation of gravity is left out")
    limits, bare, uneven = [], list[str](), list[str]()
    for joint in range(1, model.njnt):
        motors = motors_of(model, joint)
        ranges = [torque_range(model, motor) for motor in motors]
        if model.jnt_actfrclimited[joint]:
            ranges.append(tuple(model.jnt_actfrcrange[joint]))
        down, up = (min([np.inf, *(sign * each[side] for each in ranges)]) for side, sign in ((0, -1), (1, 1)))
        limits.append(min(down, up))
        if model.nu and not motors:
            bare.append(model.joint(joint).name)
        if down != up:
            uneven.append(model.joint(joint).name)
    if bare:
        notes.append(f"no actuator of the file drives {', '.join(bare)}: given motors, as every joint must have one")
    if uneven:
        notes.append(f"torque limits that differ by direction are the smaller of both: {', '.join(uneven)}")
    return np.array(limits)


def _refuse_macros(root: ET.Element, file: Path) -> None:
    """Raise a UserError for a xacro, of which MuJoCo would read what is no macro and nothing else."""
    if any("xacro" in part.tag for part in root.iter()):
        raise UserError(f"cannot import '{file}': it is a xacro; make a URDF of it: xacro {file} > robot.urdf")


def _speed_limits(root: ET.Element) -> list[float]:
    """Return the speed limits [rad/s] of an URDF's joints, which MuJoCo does not read; none of a MJCF."""
    limits = [float(limit.get("velocity", 0)) for limit in root.findall("joint/limit")]
    return [limit for limit in limits if limit > 0]
