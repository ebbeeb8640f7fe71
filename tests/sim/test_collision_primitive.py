"""Contacts of two spheres, capsules or boxes against plain MuJoCo's."""

import mujoco
import numpy as np
import pytest
import warp as wp

from legged_torque.sim.fused import collision_primitive
from legged_torque.sim.fused.collision_primitive import BoxContacts, PairContacts, Shape

SIZES = {"sphere": (0.05, 0.0, 0.0), "capsule": (0.03, 0.1, 0.0), "box": (0.1, 0.06, 0.03)}
COUNT = 2000


def random_poses(seed, away=0.07):
    """Places [m] and orientations of two geoms, a third parallel or nearly so. Shapes: (2, COUNT, 3 or 4)."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(2, COUNT, 4))
    alike = COUNT // 3
    turns = rng.choice([0.0, 1e-3, 0.05], (alike, 1))
    quats[:, :alike] = [1.0, 0.0, 0.0, 0.0] + turns * rng.normal(size=(2, alike, 4))
    quats /= np.linalg.norm(quats, axis=2, keepdims=True)
    return rng.uniform(-away, away, (2, COUNT, 3)).astype(np.float32), quats


def in_mujoco(kinds, places, quats):
    """Plain MuJoCo with two such geoms, at each of the poses in turn."""
    spec = mujoco.MjSpec()
    for i, kind in enumerate(kinds):
        body = spec.worldbody.add_body(name=f"{i}")
        body.add_freejoint()
        body.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), size=SIZES[kind], mass=1.0)
    model = spec.compile()
    data = mujoco.MjData(model)
    for pair in range(COUNT):
        data.qpos[:] = np.concatenate([[*places[i, pair], *quats[i, pair]] for i in range(2)])
        mujoco.mj_fwdPosition(model, data)
        yield model, data


def mujoco_contacts(data):
    """Distances, places and normals of plain MuJoCo's contacts."""
    return [(c.dist, c.pos.copy(), c.frame[:3].copy()) for c in data.contact if c.dist < 0.0]


def shapes_of(kind, places, quats):
    """Geoms of a kind for a kernel."""
    values = np.zeros(COUNT, Shape.numpy_dtype())
    values["pos"], values["size"] = places, SIZES[kind]
    matrix = np.zeros(9)
    for i in range(COUNT):
        mujoco.mju_quat2Mat(matrix, quats[i])
        values["rot"][i] = matrix.reshape(3, 3)
    return wp.array(values, dtype=Shape, device="cpu")


def of_pairs(function, result, kinds, places, quats):
    """Results of a function of two geoms for each of the poses."""

    @wp.kernel(module="unique", enable_backward=False)
    def for_all(a: wp.array(dtype=Shape), b: wp.array(dtype=Shape), out: wp.array(dtype=result)):
        """Ask it of one pair."""
        out[wp.tid()] = function(a[wp.tid()], b[wp.tid()])

    shapes = [shapes_of(*each) for each in zip(kinds, places, quats, strict=True)]
    out = wp.empty(COUNT, dtype=result, device="cpu")
    wp.launch(for_all, COUNT, [*shapes, out], device="cpu")
    return out.numpy()


def own_contacts(kinds, places, quats):
    """Distances, places and normals of our function for these kinds."""
    collide = getattr(collision_primitive, "_".join(kinds))
    result = BoxContacts if kinds == ["box", "box"] else PairContacts

    @wp.func
    def first_of(a: Shape, b: Shape):
        """Collide one pair, without contacts before."""
        return collide(result(), a, b)

    rows = of_pairs(first_of, result, kinds, places, quats)
    return [[(row["dist"][i], row["pos"][i], row["normal"][i]) for i in range(row["count"])] for row in rows]


def difference(ours, theirs):
    """How far the nearest of MuJoCo's contacts is from one of ours, in place, depth [m] and normal."""
    (dist, pos, normal), (own_dist, own_pos, own_normal) = theirs, ours
    return max(abs(dist - own_dist), np.abs(pos - own_pos).max(), 0.1 * np.abs(normal - own_normal).max())


@pytest.mark.parametrize(
    "kinds", ["sphere sphere", "sphere capsule", "sphere box", "capsule capsule", "capsule box", "box box"]
)
def test_contacts_are_mujocos(kinds):
    """As many contacts as MuJoCo has, each like one of MuJoCo's; rounding decides for a few of a thousand pairs."""
    kinds, (places, quats) = kinds.split(), random_poses(seed=1)
    expected = [mujoco_contacts(data) for _, data in in_mujoco(kinds, places, quats)]
    found = own_contacts(kinds, places, quats)
    pairs = list(zip(found, expected, strict=True))
    counted = [(ours, theirs) for ours, theirs in pairs if len(ours) == len(theirs)]
    assert len(counted) >= 0.995 * COUNT
    errors = [max(min(difference(c, other) for other in theirs) for c in ours) for ours, theirs in counted if theirs]
    assert np.mean(np.array(errors) < 1e-5) > 0.995 and len(errors) > 0.4 * COUNT
    several = np.mean([len(theirs) > 1 for theirs in expected])
    assert several == 0.0 if "sphere" in kinds else several > 0.03


@pytest.mark.parametrize("kinds", ["sphere capsule", "sphere box", "capsule capsule", "capsule box"])
def test_planes_between(kinds):
    """No plane is between geoms that touch in MuJoCo, which also says how far apart others are: most have one."""
    kinds, (places, quats) = kinds.split(), random_poses(seed=2, away=0.15)
    between = "between_capsule_and_box" if "box" in kinds else "between_capsules"
    separate = of_pairs(getattr(collision_primitive, between), wp.bool, kinds, places, quats).astype(bool)
    poses = in_mujoco(kinds, places, quats)
    apart = np.array([mujoco.mj_geomDistance(model, data, 0, 1, 1.0, None) for model, data in poses])
    assert apart[separate].min() > -1e-6 and (apart < 0.0).mean() > 0.05
    assert separate[apart > 0.02].mean() > 0.8
