"""Published robots rebuilt from their figures: a URDF or MJCF with the bodies, joints, shapes and motors of each.

``tests/importer/published_facts.json`` has names and numbers of five digits, with the source and licence of each.
Meshes are the boxes around them; what neither moves nor touches is left out.
"""

import json
from pathlib import Path

FACTS = json.loads((Path(__file__).parents[1] / "importer" / "published_facts.json").read_text())


def text_of(numbers):
    """Return numbers as XML has them."""
    return " ".join(map(str, numbers))


def published(name):
    """Return the text of the file of a robot."""
    facts = FACTS[name]
    return (
        urdf_of(facts["links"], facts["joints"])
        if "links" in facts
        else mjcf_of(facts["bodies"], facts["motors"], facts["keys"])
    )


def urdf_of(links, joints):
    """Return a URDF. Links: name to (mass, com, rpy, inertia) or nothing, and shapes; joints as in the file."""
    parts = []
    for name, (inertial, shapes) in links.items():
        parts.append(f'<link name="{name}">')
        if inertial:
            mass, xyz, rpy, inertia = inertial
            keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
            values = " ".join(f'{key}="{value}"' for key, value in zip(keys, inertia, strict=True))
            place = f'<origin xyz="{text_of(xyz)}" rpy="{text_of(rpy)}"/>'
            parts.append(f'<inertial>{place}<mass value="{mass}"/><inertia {values}/></inertial>')
        for kind, size, xyz, rpy in shapes:
            keys = {"box": ["size"], "sphere": ["radius"], "cylinder": ["radius", "length"]}[kind]
            values = [text_of(size)] if kind == "box" else size
            sizes = " ".join(f'{key}="{value}"' for key, value in zip(keys, values, strict=True))
            place = f'<origin xyz="{text_of(xyz)}" rpy="{text_of(rpy)}"/>'
            parts.append(f"<collision>{place}<geometry><{kind} {sizes}/></geometry></collision>")
        parts.append("</link>")
    for name, kind, parent, child, xyz, rpy, axis, limit in joints:
        keys = ("lower", "upper", "effort", "velocity")
        limits = " ".join(f'{key}="{value}"' for key, value in zip(keys, limit, strict=False))
        parts.append(
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{text_of(xyz)}" rpy="{text_of(rpy)}"/><axis xyz="{text_of(axis)}"/>'
            f"{f'<limit {limits}/>' if limit else ''}</joint>"
        )
    return f'<robot name="robot">{"".join(parts)}</robot>'


def mjcf_of(bodies, motors, keys):
    """Return an MJCF. Bodies come after their parents, which are named by their numbers; 0 is the world."""

    def body(number):
        name, _, pos, quat, mass, ipos, iquat, inertia, joints, geoms = bodies[number - 1]
        text = f'<body name="{name}" pos="{text_of(pos)}" quat="{text_of(quat)}"><inertial mass="{mass}" '
        text += f'pos="{text_of(ipos)}" quat="{text_of(iquat)}" diaginertia="{text_of(inertia)}"/>'
        for joint, *values in joints:
            damping, armature, friction = values[0] if joint == "free" else values[2]
            passive = f'damping="{damping}" armature="{armature}" frictionloss="{friction}"'
            if joint == "free":
                text += f'<joint type="free" {passive}/>'
                continue
            axis, span, _, force = values
            limits = f' range="{text_of(span)}"' if span else ""
            limits += f' actuatorfrcrange="{text_of(force)}"' if force else ""
            text += f'<joint name="{joint}" axis="{text_of(axis)}" {passive}{limits}/>'
        for kind, size, place, turn in geoms:
            text += f'<geom type="{kind}" size="{text_of(size)}" pos="{text_of(place)}" quat="{text_of(turn)}"/>'
        children = (child for child, row in enumerate(bodies, 1) if row[1] == number)
        return text + "".join(body(child) for child in children) + "</body>"

    roots = "".join(body(number) for number, row in enumerate(bodies, 1) if row[1] == 0)
    driven = "".join(f'<motor joint="{j}" {f"""forcerange="{text_of(r)}" """ if r else ""}/>' for j, r in motors)
    frames = "".join(f'<key name="{name}" qpos="{text_of(qpos)}"/>' for name, qpos in keys)
    head = '<mujoco><compiler angle="radian" autolimits="true" inertiafromgeom="false"/><worldbody>'
    return f"{head}{roots}</worldbody><actuator>{driven}</actuator><keyframe>{frames}</keyframe></mujoco>"
