"""Reading a published MJCF or URDF: its parts as MuJoCo understands them, and notes on what was changed."""

import re
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from legged_torque.importer.shapes import rotation
from legged_torque.utils.errors import UserError, refuse
from legged_torque.utils.mjcf import kept_warnings, motors_of, torque_range

MESH_TYPES = (".stl", ".obj", ".msh")  # files that MuJoCo reads
COLLISION_GROUP = 3  # of Menagerie's collision geoms, also of those that one of its files switches off
TINY = 1e-6  # inertia and mass up to which a fixed link has none; MuJoCo refuses less [kg m^2], [kg]
GRAVITY = 9.81  # of all robots; that of the file does not count [m/s^2]
HEAVIEST = 1e4  # mass of a robot that is none [kg]
DIGITS = 1e-5  # share of the largest moment of inertia by which six digits may break A + B >= C
NAME = re.compile(r"[A-Za-z0-9_.:/-]*")  # names of bodies and joints, which become parts of settings and of a MJCF
SITE = "link:"  # prefix of the names of sites in the places of fixed links
PARENTS = 4  # folders above that of the file in which meshes are looked for


class Notes(list[str]):
    """Changes and reasons, a line each."""

    def on(self, parts: Iterable[str], reason: str) -> None:
        """Add a reason followed by the names of parts, if there are any."""
        names = ", ".join(parts)
        known = [place for place, note in enumerate(self) if names and note.startswith(f"{reason}: ")]
        if known:
            self[known[0]] += f", {names}"
        elif names:
            self.append(f"{reason}: {names}")


@dataclass
class Source:
    """A robot as its file describes it: a floating trunk, every other body with one hinge joint.

    Fixed links are parts of the bodies that they are fixed to; ``sites`` has their places: by body, their names and
    positions [m] in its frame.
    """

    file: Path
    model: mujoco.MjModel
    sites: dict[int, list[tuple[str, np.ndarray]]]
    poses: dict[str, np.ndarray]  # of the file's keyframes, "home" first: angles by hinge joint [rad]
    torque_limits: np.ndarray  # of the file, by joint; infinite without any [N m]
    speed_limits: list[float]  # of a URDF [rad/s]
    notes: Notes

    @property
    def joints(self) -> list[str]:
        """Names of the hinge joints, in the order of the file."""
        return [self.model.joint(i).name for i in range(1, self.model.njnt)]

    @property
    def weight(self) -> float:
        """Weight [N]."""
        return GRAVITY * float(self.model.body_mass.sum())

    def which(self, joints: np.ndarray) -> list[str]:
        """Return the names of the joints for which an array is true. Shape: (joints,), bool."""
        return [name for name, chosen in zip(self.joints, joints, strict=True) if chosen]


def read_source(file: Path) -> Source:
    """Read a MJCF or URDF; a UserError says why it cannot become a robot of this library."""
    what = f"cannot import '{file}'"
    if not file.is_file():
        raise UserError(f"{what}: there is no such file")
    with kept_warnings(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # problems are reported when the result is loaded
        try:
            root = ET.parse(file).getroot()
            if any("xacro" in part.tag for part in root.iter()):  # MuJoCo would read the rest and nothing else
                raise UserError(f"{what}: it is a xacro; make a URDF of it: xacro {file} > robot.urdf")
            for part in root.iter():
                part.tag = part.tag.rpartition("}")[2]  # which MuJoCo reads without a namespace
            weightless = _prepare_urdf(root, what)
            is_urdf = root.tag == "robot"
            text = ET.tostring(root, encoding="unicode")
            spec = mujoco.MjSpec.from_string(text) if is_urdf else mujoco.MjSpec.from_file(str(file))
            names = dict.fromkeys(part.name for part in [*spec.bodies, *spec.joints])
            odd = ", ".join(repr(name) for name in names if not NAME.fullmatch(name))
            if odd:
                raise UserError(f"{what}: names may have letters, digits and _ . : / -, not {odd}")
            negative = [body for body in spec.bodies if body.mass < 0.0]
            refuse([f"'{body.name}' must weigh 0 kg or more, not {body.mass:g}" for body in negative], what)
            notes = _prepare(spec, file, is_urdf)
            notes.on(weightless, "without a mass in the file: they weigh what is fixed to them")
            model = _compile(spec, notes)
            speeds = [float(limit.get("velocity", 0)) for limit in root.findall("joint/limit")]  # of a URDF
        except (ValueError, LookupError, RecursionError, ET.ParseError, mujoco.FatalError) as error:
            raise UserError(f"{what}: {' '.join(str(error).split())}") from None
    hinge, free = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_FREE
    others = [model.joint(i).name for i in range(1, model.njnt) if model.jnt_type[i] != hinge]
    several = [model.body(b).name for b in range(1, model.nbody) if model.body_jntnum[b] > 1]
    fixed = [model.body(b).name for b in range(2, model.nbody) if not model.body_jntnum[b]]
    elsewhere = np.flatnonzero(model.actuator_trntype != mujoco.mjtTrn.mjTRN_JOINT)
    pushing = ", ".join(model.actuator(i).name or f"number {i + 1}" for i in elsewhere)
    rules = {
        "its trunk does not float": model.njnt < 2 or model.jnt_type[0] != free,
        f"only hinge joints can be imported, not {', '.join(others)}": others,
        f"a body may have one joint, {', '.join(several)} have more": several,
        f"a body without joints that something refers to cannot be imported: {', '.join(fixed)}": fixed,
        f"actuators that do not act on a joint cannot be imported: {pushing}": pushing,
        f"its {model.neq} equalities (closed loops, mimicked joints) cannot be imported": model.neq,
        f"its {model.ntendon} tendons cannot be imported": model.ntendon,
        f"it weighs {model.body_mass.sum():g} kg, at most {HEAVIEST:g} make sense": model.body_mass.sum() > HEAVIEST,
    }
    refuse([reason for reason, is_broken in rules.items() if is_broken], what)
    sites: dict[int, list] = {}
    for site in range(model.nsite):
        name = model.site(site).name.removeprefix(SITE)
        sites.setdefault(int(model.site_bodyid[site]), []).append((name, model.site_pos[site].copy()))
    keys = sorted(range(model.nkey), key=lambda key: model.key(key).name != "home")
    poses = {model.key(key).name or f"number {key + 1}": model.key_qpos[key][7:].copy() for key in keys}
    limits = _torque_limits(model, notes)
    _take_from_actuators(model)
    _note_left_out(model, notes)
    return Source(file, model, sites, poses, limits, [speed for speed in speeds if speed > 0], notes)


def _prepare_urdf(root: ET.Element, what: str) -> list[str]:
    """Remove what MuJoCo need not read of a URDF, and give joints with one limit the other, 0.

    Returns the names of moving links without a mass of their own.
    """
    for link in root.findall("link"):  # shapes follow from its collision geoms
        for part in link.findall("visual"):
            link.remove(part)
    for part in root.findall("material"):
        root.remove(part)
    for joint in root.findall("joint[@type='revolute']"):
        limit = joint.find("limit")
        if limit is not None and limit.attrib.keys() & {"lower", "upper"}:
            low, high = limit.attrib.setdefault("lower", "0"), limit.attrib.setdefault("upper", "0")
            if float(low) >= float(high):  # MuJoCo would take equal ones for none
                raise UserError(f"{what}: '{joint.get('name')}' must be fixed or have lower < upper, not {low}, {high}")
    joints = (joint for joint in root.findall("joint") if joint.get("type") != "fixed")
    moving = {child.get("link") for joint in joints for child in joint.findall("child")}
    links = {link.get("name", ""): link for link in root.findall("link") if link.get("name") in moving}
    return [name for name, link in links.items() if not any(float(mass.get("value", 0)) for mass in link.iter("mass"))]


def _prepare(spec: mujoco.MjSpec, file: Path, is_urdf: bool) -> Notes:
    """Make a file compile to one floating robot without anything else; return notes on the changes."""
    notes = _find_meshes(spec, file, is_urdf)
    in_pairs = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    for part in [*spec.sensors, *spec.lights, *spec.cameras, *spec.sites, *spec.excludes, *spec.pairs]:
        spec.delete(part)
    for part in [*spec.skins, *spec.tuples]:
        spec.delete(part)
    switched_on = dict[str, None]()
    for geom in spec.geoms:
        geom.material = ""
        if not (geom.contype or geom.conaffinity) and (geom.group == COLLISION_GROUP or geom.name in in_pairs):
            geom.conaffinity = 1
            if geom.name not in in_pairs:
                switched_on[geom.parent.name] = None
    notes.on(switched_on, f"geoms of group {COLLISION_GROUP}, which the file switches off, collide")
    for part in [*spec.materials, *spec.textures]:
        spec.delete(part)
    _keep_robot(spec, file, is_urdf, notes)
    notes += ["left out: the compensation of gravity"] if any(body.gravcomp for body in spec.bodies) else []
    for body in spec.bodies:
        body.gravcomp = 0.0  # else a fixed link stays a body of its own
        if body.name and not body.joints and body.name != "world":
            body.add_site(name=SITE + body.name)
    unnamed = [joint for joint in spec.joints if not joint.name and joint.type != mujoco.mjtJoint.mjJNT_FREE]
    for number, joint in enumerate(unnamed, 1):
        joint.name = f"{joint.parent.name or number}_joint"
        notes.append(f"the joint of '{joint.parent.name}' had no name: '{joint.name}'")
    if not np.allclose(spec.option.gravity, [0.0, 0.0, -GRAVITY], atol=0.01):
        notes.append(f"gravity is {GRAVITY} m/s^2 along -z, not the file's {np.round(spec.option.gravity, 3).tolist()}")
    spec.option.gravity, spec.option.disableflags = [0.0, 0.0, -GRAVITY], 0
    if is_urdf:  # only <inertial> has masses
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
        for geom in spec.geoms:
            geom.mass = 0.0
    spec.compiler.fusestatic = True
    spec.compiler.discardvisual = True
    return notes


def _keep_robot(spec: mujoco.MjSpec, file: Path, is_urdf: bool, notes: Notes) -> None:
    """Leave the one child of the world that has hinges, and let it float. Adds notes."""
    free = mujoco.mjtJoint.mjJNT_FREE
    children = {body: {joint.type for joint in body.find_all("joint")} for body in spec.worldbody.bodies}
    roots = [body for body, kinds in children.items() if kinds - {free}]
    if len(roots) != 1:
        raise UserError(f"cannot import '{file}': one child of the world must have joints, not {len(roots)}")
    others = [body for body in children if body is not roots[0]]
    notes.on((f"'{body.name}'" for body in others), "no parts of the robot, left out")
    if not roots[0].joints or any(children[body] for body in others):
        for key in list(spec.keys):
            spec.delete(key)
    for body in others:
        spec.delete(body)
    if not roots[0].joints:
        roots[0].add_freejoint()
        notes += [] if is_urdf else [f"'{roots[0].name}' was fixed to the world; it floats now"]
        (link, *others) = roots[0].bodies
        if not (others or roots[0].explicitinertial or list(roots[0].geoms) or link.joints):
            link.pos = [0.0, 0.0, 0.0]
            notes.append(f"'{roots[0].name}' is no more than a frame: the trunk's origin is that of '{link.name}'")


def _compile(spec: mujoco.MjSpec, notes: Notes) -> mujoco.MjModel:
    """Compile; impossible inertias, which MuJoCo refuses, are made possible or replaced. Adds notes.

    Only where links are fixed are those without three positive moments replaced.
    """
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
    for body in spec.bodies:
        if body.explicitinertial:
            _balance(body, notes)
    return spec.compile()


def _balance(body: mujoco.MjsBody, notes: Notes) -> None:
    """Raise the two smaller moments of inertia of a body as little as A + B >= C needs. Adds a note."""
    xx, yy, zz, xy, xz, yz = body.fullinertia
    if np.isnan(xx):
        axes, moments = rotation(body.iquat), np.array(body.inertia)
    else:
        moments, axes = np.linalg.eigh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    missing = 2.0 * moments.max() - moments.sum()
    if moments.min() <= 0.0 or missing <= 0.0:
        return
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = axes @ np.diag(balanced(moments)) @ axes.T
    body.fullinertia, body.inertia = [xx, yy, zz, xy, xz, yz], np.zeros(3)
    body.iquat = [1.0, 0.0, 0.0, 0.0]
    notes.append(
        f"the inertia of '{body.name}' broke A + B >= C by {missing:.2g} kg m^2, {missing / moments.max():.1%} of "
        "the largest moment: the two smaller ones are raised by half of that each"
    )


def balanced(moments: np.ndarray) -> np.ndarray:
    """Return moments of inertia of which A + B >= C holds in six digits, the two smaller ones raised if need be."""
    order, raised = np.argsort(moments), moments.copy()
    raised[order[:2]] += 0.5 * max(0.0, (2.0 + DIGITS) * moments[order[2]] - moments.sum())
    return raised


def _find_meshes(spec: mujoco.MjSpec, file: Path, is_urdf: bool) -> Notes:
    """Set the paths of meshes; drop those that are missing or that MuJoCo cannot read, and return notes.

    A mesh is at its path in the file, or at an end of it below a parent folder.
    """
    missing, lost, types, folder = {}, dict[str, mujoco.MjsBody](), ", ".join(MESH_TYPES), file.absolute().parent
    roots = [folder / spec.meshdir, folder, *list(folder.parents)[:PARENTS]]
    for mesh in [mesh for mesh in spec.meshes if mesh.file]:
        parts = Path(mesh.file.split("://")[-1]).parts
        paths = [root.joinpath(*parts[start:]) for root in roots for start in range(len(parts))]
        files = (path.with_suffix(kind) for path in paths for kind in (path.suffix, *MESH_TYPES))
        found = next((path for path in files if path.suffix.lower() in MESH_TYPES and path.is_file()), None)
        mesh.name = mesh.name or Path(mesh.file).stem
        if found:
            mesh.file = str(found)
        else:
            missing[mesh.name] = mesh
    spec.meshdir, spec.strippath = "", False
    weighs = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    for geom in [geom for geom in spec.geoms if geom.meshname in missing]:
        if not is_urdf and (weighs or not geom.parent.explicitinertial):
            raise UserError(
                f"cannot import '{file}': the inertia of '{geom.parent.name}' follows from the mesh "
                f"'{missing[geom.meshname].file}', which is missing or of a type other than {types}"
            )
        if geom.contype or geom.conaffinity:
            lost[geom.parent.name] = geom.parent
        spec.delete(geom)
    for mesh in missing.values():
        spec.delete(mesh)
    notes, reason = Notes(), f"collision meshes are missing or not {types}"
    others = [name for name, body in lost.items() if any(geom.contype or geom.conaffinity for geom in body.geoms)]
    notes.on((name for name in lost if name not in others), f"{reason}, so shapes follow from inertias")
    notes.on(others, f"{reason} and left out, other shapes remain")
    return notes


def _torque_limits(model: mujoco.MjModel, notes: Notes) -> np.ndarray:
    """Return the torque limit of each hinge, in its weaker direction [N m]. Shape: (joints,). Adds notes.

    It is the sum of its motors', or the joint's own.
    """
    is_off = (1 << model.actuator_group.astype(np.int64)) & model.opt.disableactuator != 0
    off = dict.fromkeys(model.joint(joint).name for joint in model.actuator_trnid[is_off, 0])
    notes.on(off, "actuators of groups that the file disables are left out")
    rates = model.actuator_dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR  # whose activations, not controls, are torques
    model.actuator_ctrlrange[rates] = model.actuator_actrange[rates]
    model.actuator_ctrllimited[rates] = model.actuator_actlimited[rates]
    is_servo = ~is_off & (model.actuator_biastype != mujoco.mjtBias.mjBIAS_NONE)
    model.actuator_ctrllimited[is_servo] = False  # their controls are not torques
    if is_servo.any():
        notes.append(f"{is_servo.sum()} position or velocity servos became motors; their gains are left out")
    limits, bare, uneven = [], list[str](), list[str]()
    for joint in range(1, model.njnt):
        motors, name = [motor for motor in motors_of(model, joint) if not is_off[motor]], model.joint(joint).name
        low, high = np.sum([torque_range(model, motor) for motor in motors], axis=0) if motors else (-np.inf, np.inf)
        own = model.jnt_actfrcrange[joint] if model.jnt_actfrclimited[joint] else (-np.inf, np.inf)
        down, up = min(-low, -own[0]), min(high, own[1])
        limits.append(min(down, up))
        bare += [name] if model.nu and not motors else []
        uneven += [name] if down != up else []
    notes.on(bare, "joints that no actuator of the file drives get motors, as every joint must have one")
    notes.on(uneven, "torque limits that differ by direction are the smaller of both")
    return np.array(limits)


def _take_from_actuators(model: mujoco.MjModel) -> None:
    """Move armature and damping of actuators, on the motors' side of their gears, to the joints that they act on."""
    dofs = model.jnt_dofadr[model.actuator_trnid[:, 0]]
    for name in ("armature", "damping"):
        values = getattr(model, f"actuator_{name}", None)  # not in all versions of MuJoCo
        if values is not None:
            np.add.at(getattr(model, f"dof_{name}"), dofs, model.actuator_gear[:, 0] ** 2 * values)
            values[:] = 0.0


def _note_left_out(model: mujoco.MjModel, notes: Notes) -> None:
    """Add notes on what a file has that robots of this library have not."""
    trunk = (model.dof_damping[:6], model.dof_armature[:6], model.dof_frictionloss[:6], model.jnt_stiffness[:1])
    polynomials = ("dof_dampingpoly", "jnt_stiffnesspoly", "actuator_dampingpoly")  # not in all versions of MuJoCo
    found = {
        "damping, armature, dry friction and stiffness of the trunk's free joint": trunk,
        "polynomial terms of damping and stiffness": [getattr(model, name, 0.0) for name in polynomials],
        "density, viscosity and wind": (model.opt.density, model.opt.viscosity, model.opt.wind),
        "the dynamics of actuators (filters, activations)": [model.actuator_dyntype],
        "the delays of actuators": [getattr(model, "actuator_delay", 0.0)],
        "geoms of the world, such as floors": [model.geom_bodyid == 0],
    }
    notes += [f"left out: {what}" for what, values in found.items() if any(np.any(value) for value in values)]
