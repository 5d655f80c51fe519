# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""How colcon installs the package. pip installs all packages by the pyproject.toml of the repository."""

from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

NAME = "uwb_tdoa_bias"

setup(
    name=NAME,
    version=ElementTree.parse(Path(__file__).with_name("package.xml")).findtext("version"),
    description="Predicts and removes the systematic error of UWB TDOA measurements",
    maintainer="uwb_tdoa maintainers",
    maintainer_email="maintainers@uwb-tdoa.invalid",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    python_requires=">=3.10",
    install_requires=["setuptools"],  # package.xml says what else: rosdep installs it
    # colcon test runs pytest because of this
    extras_require={"test": ["hypothesis>=6.60", "pytest>=7.0"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", glob("config/*.yaml")),
    ],
    zip_safe=False,  # numba keeps its cache beside the modules
    entry_points={
        "console_scripts": [
            "anchors_node = uwb_tdoa_bias.executables:anchors_node",
            "bias_node = uwb_tdoa_bias.executables:bias_node",
        ]
    },
)
