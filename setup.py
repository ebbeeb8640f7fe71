"""Which folders of the repository are installed as parts of the package; its metadata is in pyproject.toml."""

from setuptools import find_packages, setup

# At the top level one finds them; in an installed environment they are found by the package.
BESIDE = {
    "legged_torque.resources": "resources",
    "legged_torque.scripts": "scripts",
    "legged_torque.descriptions": "experiments",
}

BESIDE |= {f"legged_torque.{name}": name.replace(".", "/") for name in find_packages(include=["paper", "paper.*"])}

setup(
    packages=[*find_packages(include=["legged_torque", "legged_torque.*"]), *BESIDE],
    package_dir=BESIDE,
    package_data={
        "legged_torque.deploy": ["policy.schema.json"],
        "legged_torque.importer": ["scene.xml"],
        "legged_torque.utils": ["successors.yaml"],
        "legged_torque.viewer": ["page.js", "static/*"],
        "legged_torque.resources": ["policies/**", "robots/**"],
        "legged_torque.descriptions": ["*.yaml"],
        "legged_torque.paper.report": ["*.jinja"],
    },
    include_package_data=False,  # what a wheel holds stands here; MANIFEST.in is for the source archive
)
