"""Metadata of the package."""

import re
from pathlib import Path

from setuptools import find_packages, setup

ROOT = Path(__file__).parent
VERSION = re.search(r'__version__ = "(.+?)"', (ROOT / "legged_torque" / "__init__.py").read_text("utf-8")).group(1)
EXPORT = ["onnx>=1.16,<2", "onnxruntime>=1.18,<2", "jsonschema>=4.18,<5"]

setup(
    name="legged_torque",
    version=VERSION,
    description="Massively parallel training of torque-controlled legged robots on MuJoCo Warp and rsl_rl",
    long_description=(ROOT / "README.md").read_text("utf-8"),
    long_description_content_type="text/markdown",
    license="BSD-3-Clause",
    packages=find_packages(include=["legged_torque", "legged_torque.*"]),
    package_data={"legged_torque.deploy": ["policy.schema.json"]},
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
        "video": ["imageio", "imageio-ffmpeg", "pillow>=10.1"],
        "plots": ["matplotlib"],
        "viewer": ["viser>=1.1,<2", "trimesh>=4.8,<6", "pillow"],
        "wandb": ["wandb"],
        "export": EXPORT,
        "test": ["pytest", "pytest-xdist>=3.6,<4", "matplotlib", "imageio", "imageio-ffmpeg", "pillow>=10.1", *EXPORT],
    },
)
