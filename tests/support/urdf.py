"""URDFs from tables of links and joints."""


def text_of(numbers):
    """Return numbers as XML has them."""
    return " ".join(map(str, numbers))


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
