# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""How colcon installs the package. pip installs all packages by the pyproject.toml of the repository."""

from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

NAME = "uwb_tdoa_tools"

setup(
    name=NAME,
    version=ElementTree.parse(Path(__file__).with_name("package.xml")).findtext("version"),
    description=(
        "Reads, converts, simulates, replays and evaluates flights of UWB TDOA measurements"
    ),
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
        (f"share/{NAME}/launch", glob("launch/*.py")),
    ],
    package_data={NAME: ["diagnosis/report/templates/*", "readers/profiles/*"]},
    zip_safe=False,  # numba keeps its cache beside the modules
    entry_points={
        "console_scripts": [
            "autopilot_node = uwb_tdoa_tools.executables:autopilot_node",
            "calibrate = uwb_tdoa_tools.executables:calibrate",
            "calibration_node = uwb_tdoa_tools.executables:calibration_node",
            "check = uwb_tdoa_tools.executables:check",
            "convert = uwb_tdoa_tools.executables:convert",
            "debias = uwb_tdoa_tools.executables:debias",
            "demo = uwb_tdoa_tools.executables:demo",
            "diagnose = uwb_tdoa_tools.executables:diagnose",
            "evaluate = uwb_tdoa_tools.executables:evaluate",
            "export = uwb_tdoa_tools.executables:export",
            "fly = uwb_tdoa_tools.executables:fly",
            "inject = uwb_tdoa_tools.executables:inject",
            "localize = uwb_tdoa_tools.executables:localize",
            "map_anchors = uwb_tdoa_tools.executables:map_anchors",
            "plan = uwb_tdoa_tools.executables:plan",
            "replay = uwb_tdoa_tools.executables:replay",
            "simulate = uwb_tdoa_tools.executables:simulate",
            "survey = uwb_tdoa_tools.executables:survey",
            "train = uwb_tdoa_tools.executables:train",
            "vehicle_node = uwb_tdoa_tools.executables:vehicle_node",
        ]
    },
)
