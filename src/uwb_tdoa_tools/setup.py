from setuptools import find_packages, setup

NAME = "uwb_tdoa_tools"

setup(
    name=NAME,
    version="0.1.0",
    description="Reads, converts, simulates, replays, records and evaluates flights of UWB TDOA measurements",
    maintainer="uwb_tdoa maintainers",
    maintainer_email="maintainers@uwb-tdoa.invalid",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    python_requires=">=3.10",
    install_requires=[
        "setuptools",
        "joblib>=1.3",
        "matplotlib>=3.6",
        "numba>=0.57",
        "numpy>=1.26",
        "onnx>=1.14",
        "PyYAML>=6.0",
        "rosbags>=0.10",
        "scikit-learn>=1.3",
        "scipy>=1.11",
        "tqdm>=4.64",
        "uwb_tdoa_bias",
        "uwb_tdoa_ekf",
    ],
    extras_require={"dask": ["distributed>=2024.1"]},  # for --dask
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
    ],
    zip_safe=False,  # numba keeps its cache beside the modules
    entry_points={
        "console_scripts": [
            "bench = uwb_tdoa_tools.commands.bench:main",
            "compare_models = uwb_tdoa_tools.commands.compare_models:main",
            "convert = uwb_tdoa_tools.commands.convert:main",
            "demo = uwb_tdoa_tools.commands.demo:main",
            "debias = uwb_tdoa_tools.commands.debias:main",
            "diagnose = uwb_tdoa_tools.commands.diagnose:main",
            "diagnose_bench = uwb_tdoa_tools.commands.diagnose_bench:main",
            "evaluate = uwb_tdoa_tools.commands.evaluate:main",
            "inject = uwb_tdoa_tools.commands.inject:main",
            "plan = uwb_tdoa_tools.commands.plan:main",
            "record = uwb_tdoa_tools.commands.record:main",
            "replay = uwb_tdoa_tools.commands.replay:main",
            "simulate = uwb_tdoa_tools.commands.simulate:main",
            "spin = uwb_tdoa_tools.commands.spin:main",
            "train = uwb_tdoa_tools.commands.train:main",
        ]
    },
)
