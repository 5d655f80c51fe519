# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""How colcon installs the package. pip installs all packages by the pyproject.toml of the repository."""

from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

NAME = "uwb_tdoa_ekf"

setup(
    name=NAME,
    version=ElementTree.parse(Path(__file__).with_name("package.xml")).findtext("version"),
    description="Error-state Kalman filter on IMU and corrected UWB TDOA measurements",
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
        (f"share/{NAME}/foxglove", glob("foxglove/*.json")),
        (f"share/{NAME}/launch", glob("launch/*.py")),
        (f"share/{NAME}/rviz", glob("rviz/*.rviz")),
        (f"share/{NAME}/sros2", glob("sros2/*.xml")),
    ],
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "compile_nodes = uwb_tdoa_ekf.executables:compile_nodes",
            "debias_node = uwb_tdoa_ekf.executables:debias_node",
            "ekf_node = uwb_tdoa_ekf.executables:ekf_node",
            "localization_node = uwb_tdoa_ekf.executables:localization_node",
        ]
    },
)
