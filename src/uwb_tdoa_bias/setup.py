"""How colcon and pip install the package."""

from glob import glob

from setuptools import find_packages, setup

NAME = "uwb_tdoa_bias"

setup(
    name=NAME,
    version="0.1.0",
    description="Predicts and removes the systematic error of UWB TDOA measurements",
    maintainer="uwb_tdoa maintainers",
    maintainer_email="maintainers@uwb-tdoa.invalid",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    python_requires=">=3.10",
    install_requires=[
        "setuptools",
        "numba>=0.57",
        "numpy>=1.26",
        "onnxruntime>=1.17",
        "PyYAML>=6.0",
        "scipy>=1.11",
    ],
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
