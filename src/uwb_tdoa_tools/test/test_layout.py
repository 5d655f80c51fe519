# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The layout of the packages, read from their sources: imports and declared dependencies."""

import ast
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
import re
import sys
from xml.etree import ElementTree

import pytest

from uwb_tdoa_bias.effects import EFFECTS, LabelEffect
from uwb_tdoa_tools.diagnosis.channels import CHANNELS
from uwb_tdoa_tools.diagnosis.detectors import DETECTORS

SRC = Path(__file__).resolve().parents[2]
# packages may import packages to their left
ORDER = ("uwb_tdoa_msgs", "uwb_tdoa_bias", "uwb_tdoa_ekf", "uwb_tdoa_tools")
PACKAGES = ORDER[1:]
# the public module, which a package installs in addition to its own
API = {"uwb_tdoa_tools": ("uwb_tdoa",)}
# Modules that use ROS. All others can be imported and tested without it.
ROS = """
    uwb_tdoa_bias.anchors_node uwb_tdoa_bias.bias_node
    uwb_tdoa_bias.ros.anchors uwb_tdoa_bias.ros.cdr
    uwb_tdoa_bias.ros.node
    uwb_tdoa_bias.ros.topics
    uwb_tdoa_ekf.debias_node uwb_tdoa_ekf.ekf_node uwb_tdoa_ekf.ekf_parameters
    uwb_tdoa_ekf.launching
    uwb_tdoa_ekf.launching_actions uwb_tdoa_ekf.localization_node uwb_tdoa_ekf.outputs
    uwb_tdoa_ekf.monitoring.health
    uwb_tdoa_tools.autopilot.crazyflie uwb_tdoa_tools.autopilot_node
    uwb_tdoa_tools.calibration_node
    uwb_tdoa_tools.live.replay uwb_tdoa_tools.live.session
    uwb_tdoa_tools.flying.over_topics uwb_tdoa_tools.vehicle_node
""".split()
IS_ROS = re.compile(r"rclpy|\w+_msgs|\w+_interfaces|domain_coordinator|ament_index_python")
# import name: (rosdep key, name on the Python package index)
# ROS packages are imported under their own name
KEYS = {
    "backports": (None, "backports.zstd"),  # installed with rosbags, like lz4
    "cflib": (None, "cflib"),  # for protocol crazyflie
    "hypothesis": ("python3-hypothesis", "hypothesis"),
    "jinja2": ("python3-jinja2", "Jinja2"),
    "joblib": ("python3-joblib", "joblib"),
    "lz4": (None, "lz4"),
    "matplotlib": ("python3-matplotlib", "matplotlib"),
    "numba": ("python3-numba", "numba"),
    "numpy": ("python3-numpy", "numpy"),
    "onnx": (None, "onnx"),  # has no rosdep key: README
    "onnxruntime": ("python3-onnxruntime-pip", "onnxruntime"),
    "pymavlink": (None, "pymavlink"),  # for protocol mavlink
    "pytest": ("python3-pytest", "pytest"),
    "rosbags": ("python3-rosbags-pip", "rosbags"),
    "pandas": (None, "pandas"),  # optional, for tables
    "scipy": ("python3-scipy", "scipy"),
    "serial": (None, "pyserial"),  # for protocol mavlink over a serial port
    "sklearn": ("python3-sklearn", "scikit-learn"),
    "tqdm": ("python3-tqdm", "tqdm"),
    "yaml": ("python3-yaml", "PyYAML"),
}
# programs that launch files start, and the launch system
STARTED = {"uwb_tdoa_ekf": {"ros2bag", "ros2launch", "rviz2"}}


@cache
def modules():
    """Return {module: path} of all our packages."""
    found = {}
    for package in PACKAGES:
        folders = [SRC / package / name for name in (package, *API.get(package, ()))]
        for path in (path for folder in folders for path in folder.rglob("*.py")):
            parts = path.relative_to(SRC / package).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def statements(path):
    """Return (import statements at any depth, those at the top level outside of try blocks)."""
    tree = ast.parse(path.read_text())
    kinds = ast.Import, ast.ImportFrom
    return tuple(
        [node for node in nodes if isinstance(node, kinds)] for nodes in (ast.walk(tree), tree.body)
    )


@cache
def imports(module, top_only=False):
    """Return the imports of a module: full names of modules and packages."""
    path = modules()[module]
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    found = set()
    for node in statements(path)[top_only]:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
            continue
        above = package.split(".")[: package.count(".") + 2 - node.level] if node.level else []
        base = ".".join([*above, *filter(None, [node.module])])
        assert not node.level or base in modules(), f"{module}: line {node.lineno}"
        inner = {f"{base}.{alias.name}" for alias in node.names}
        found |= (inner & modules().keys()) or {base}
    return frozenset(found)


def test_who_may_import_whom():
    """Packages import packages to their left. The common types stand alone."""
    for module in modules():
        own = module.partition(".")[0]
        for name in imports(module):
            package = name.partition(".")[0]
            said = f"{module} imports {name}"
            assert ".commands" not in name, said
            assert own == "uwb_tdoa" or package != "uwb_tdoa", said
            if package in ORDER and own in ORDER:
                assert ORDER.index(package) <= ORDER.index(own), said
            if module.startswith("uwb_tdoa_bias.common") and name in modules():
                assert name.startswith("uwb_tdoa_bias.common"), said


def test_files_are_on_floors():
    """Imports between files form no cycle, neither at run time nor for types."""
    TopologicalSorter(
        {module: (imports(module) & modules().keys()) - {module} for module in modules()}
    ).prepare()  # raises CycleError, which names the cycle


def test_folders_are_on_floors():
    """Imports between folders form no cycle."""
    needs = {}
    for module in modules():
        folder = folder_of(module)
        ours = imports(module) & modules().keys()
        needs.setdefault(folder, set()).update(map(folder_of, ours))
    needs.pop("")
    TopologicalSorter({folder: others - {folder, ""} for folder, others in needs.items()}).prepare()


def folder_of(module):
    """Return package.folder of a module or package, at any depth below; "" without a folder."""
    parts = module.split(".")
    return ".".join(parts[:2]) if (SRC / parts[0] / Path(*parts[:2])).is_dir() else ""


def test_nothing_imports_studies_and_they_import_no_command():
    files, studies = list(SRC.rglob("*.py")), list((SRC.parent / "studies").rglob("*.py"))
    assert len(files) > 300 and len(studies) > 20
    for paths, name in (files, "studies"), (studies, "uwb_tdoa_tools.commands"):
        banned = re.compile(rf"^\s*(from|import) {name}\b", re.MULTILINE)
        assert [path for path in paths if banned.search(path.read_text())] == []


def way_to_ros(module):
    """Return the chain of imports from a module to ROS as text; "" if it does not import ROS."""
    seen, waiting = set(), [(module,)]
    while waiting:
        way = waiting.pop()
        for name in imports(way[-1], True):
            if IS_ROS.fullmatch(name.partition(".")[0]):
                return " imports ".join((*way, name))
            parents = {
                name.rsplit(".", k)[0] for k in range(name.count(".") + 1)
            }  # an import runs their __init__
            for other in (parents & modules().keys()) - seen:
                seen.add(other)
                waiting.append((*way, other))
    return ""


def test_ros_is_imported_by_those_who_talk_it_and_nobody_else():
    ways = {module: way for module in modules() if (way := way_to_ros(module))}
    assert ways.keys() == set(ROS), ways


def names_of_messages(package):
    """Return the packages of message types that are named in strings and imported at run time."""
    texts = "".join(
        path.read_text() for path in modules().values() if path.is_relative_to(SRC / package)
    )
    return set(re.findall(r'"(\w+)/msg/\w+"', texts)) - {"pkg", package}  # from a docstring


@cache
def needed(package):
    """Return the external packages that a package and its launch files import."""
    paths = [path for path in modules().values() if path.is_relative_to(SRC / package)]
    names = set()
    for path in (*paths, *(SRC / package / "launch").glob("*.py")):
        for node in statements(path)[0]:
            if isinstance(node, ast.Import):
                names |= {alias.name.partition(".")[0] for alias in node.names}
            elif not node.level:
                names.add(node.module.partition(".")[0])
    return names - set(sys.stdlib_module_names) - {package, *API.get(package, ()), "compression"}


def declared(package, *tags):
    root = ElementTree.parse(SRC / package / "package.xml").getroot()
    return {element.text for tag in tags for element in root.iter(tag)}


@pytest.mark.parametrize("package", PACKAGES)
def test_package_xml_declares_what_is_imported_and_nothing_else(package):
    names = needed(package) | names_of_messages(package)
    used = {KEYS[name][0] if name in KEYS else name for name in names} - {None}
    assert declared(package, "depend", "exec_depend") == used | STARTED.get(package, set())


def test_pyproject_declares_what_is_imported_and_nothing_else():
    _, text = (SRC.parent / "pyproject.toml").read_text().split("\ndependencies =")
    text = "dependencies =" + text.partition("[project.scripts]")[0]
    lists = re.findall(r"^\w+ = (\[.*?\])(?: #[^\n]*)?$", text, re.MULTILINE | re.DOTALL)
    names = [re.match(r"[\w.-]+", one)[0] for some in lists for one in ast.literal_eval(some)]
    imported = set().union(*map(needed, PACKAGES))
    assert sorted(names) == sorted({KEYS[name][1] for name in imported if name in KEYS})


# files of the diagnosis that may know their own subject; the last two are about anchors and TDOAs
ROOMS = ("channels", "detectors", "deviations.py", "self_calibration")
DIAGNOSIS = SRC / "uwb_tdoa_tools" / "uwb_tdoa_tools" / "diagnosis"


def test_the_diagnosis_names_no_effect_and_no_channel():
    classes = {effect.__name__ for effect in EFFECTS.values()}
    for path in DIAGNOSIS.rglob("*.py"):
        if path.relative_to(DIAGNOSIS).parts[0] not in ROOMS:
            nodes = list(ast.walk(ast.parse(path.read_text())))
            texts = {node.value for node in nodes if isinstance(node, ast.Constant)}
            names = {node.id for node in nodes if isinstance(node, ast.Name)}
            assert not texts & {*EFFECTS, *CHANNELS} and not names & classes, path


def test_each_effect_acts_on_channels_and_is_fitted_or_has_a_detector():
    """Effects of the numbers of anchors have neither."""
    for name, effect in EFFECTS.items():
        assert set(effect.channels) <= set(CHANNELS), name
        found = effect.fitted or issubclass(effect, LabelEffect)
        assert (name in DETECTORS) != found, name
