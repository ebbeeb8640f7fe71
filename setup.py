"""Metadata of the package, and which folders of the repository are installed as parts of it."""

import re
from pathlib import Path

from setuptools import find_packages, setup

ROOT = Path(__file__).parent
VERSION = re.search(r'__version__ = "(.+?)"', (ROOT / "legged_torque" / "__init__.py").read_text("utf-8")).group(1)
EXPORT = ["onnx>=1.16,<2", "onnxruntime>=1.18,<2", "jsonschema>=4.18,<5"]
PLOTS = ["matplotlib", "scipy>=1.10,<2"]
VIDEO = ["imageio", "imageio-ffmpeg", "pillow>=10.1"]
TRITON = "triton>=3.2; sys_platform == 'linux'"  # torch for a GPU brings its own
TEST = ["pytest", TRITON, "pytest-xdist>=3.6,<4", "setuptools>=77", *PLOTS, *VIDEO, *EXPORT]

setup(
    name="legged_torque",
    version=VERSION,
    description="Massively parallel training of torque-controlled legged robots on MuJoCo Warp and rsl_rl",
    long_description=(ROOT / "README.md").read_text("utf-8"),
    long_description_content_type="text/markdown",
    license="BSD-3-Clause",
    packages=[
        *find_packages(include=["legged_torque", "legged_torque.*"]),
        "legged_torque.resources",
        "legged_torque.scripts",
    ],
    # At the top level one finds them; in an installed environment they are found by the package.
    package_dir={"legged_torque.resources": "resources", "legged_torque.scripts": "scripts"},
    package_data={
        "legged_torque.deploy": ["policy.schema.json"],
        "legged_torque.resources": ["robots/**"],
    },
    include_package_data=False,  # what a wheel holds stands here; MANIFEST.in is for the source archive
    python_requires=">=3.10",
    install_requires=[
        "torch>=2.6,<2.14",
        "rsl-rl-lib>=5.5,<6",
        "warp-lang>=1.19,<2",
        "mujoco>=3.17,<5",
        "mujoco-warp>=3.17,<5",
        "tensordict",
        "numpy",
        "pyyaml",
    ],
    extras_require={
        "video": VIDEO,
        "plots": PLOTS,
        "viewer": ["viser>=1.1,<2", "trimesh>=4.8,<6", "pillow"],
        "wandb": ["wandb"],
        "ray": ["ray>=2.52,<3"],
        "export": EXPORT,
        "docs": ["zensical>=0.0.67,<0.1"],  # the site of mkdocs.yml
        "test": TEST,
        "dev": ["ruff>=0.17,<0.18", "mypy>=2.4,<2.5", "pre-commit>=4.2,<5", "types-PyYAML"],
    },
)
