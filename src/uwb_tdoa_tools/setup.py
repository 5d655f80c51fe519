"""How colcon and pip install the package."""

from glob import glob

from setuptools import find_packages, setup

NAME = "uwb_tdoa_tools"

setup(
    name=NAME,
    version="0.1.0",
    description=(
        "Reads, converts, simulates, replays and evaluates flights of UWB TDOA measurements"
    ),
    maintainer="uwb_tdoa maintainers",
    maintainer_email="maintainers@uwb-tdoa.invalid",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    python_requires=">=3.10",
    install_requires=[
        "setuptools",
        "backports.zstd>=1.0; python_version < '3.14'",
        "Jinja2>=3.1",
        "joblib>=1.3",
        "lz4>=4.0",
        "matplotlib>=3.6",
        "numpy>=1.26",
        "onnx>=1.14",
        "Pillow>=9.0",
        "PyYAML>=6.0",
        "rosbags>=0.11.9",
        "scikit-learn>=1.3",
        "scipy>=1.11",
        "tqdm>=4.64",
        "uwb_tdoa_bias",
        "uwb_tdoa_ekf",
    ],
    extras_require={
        # cflib 0.1.29 and newer need numpy 2
        "crazyflie": ["cflib>=0.1.25"],  # for protocol crazyflie of autopilot_node
        "dask": ["distributed>=2024.1"],  # for --dask
        "mavlink": ["pymavlink>=2.4.40"],  # for protocol mavlink of autopilot_node
        "rerun": ["rerun-sdk>=0.23"],  # for --rerun; needs numpy 2
        "ulog": ["pyulog>=1.1"],  # for logs of PX4
        "oracle": ["rotorpy>=3.0"],  # beside which a test flies the vehicle of `fly`
        "test": ["hypothesis>=6.60", "pytest>=7.0"],  # colcon test runs pytest because of this
    },
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
            "plan = uwb_tdoa_tools.executables:plan",
            "replay = uwb_tdoa_tools.executables:replay",
            "simulate = uwb_tdoa_tools.executables:simulate",
            "survey = uwb_tdoa_tools.executables:survey",
            "train = uwb_tdoa_tools.executables:train",
            "vehicle_node = uwb_tdoa_tools.executables:vehicle_node",
        ]
    },
)
