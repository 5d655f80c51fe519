# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The layout of the packages, read from their sources: imports and declared dependencies."""

import ast
from functools import cache
from graphlib import TopologicalSorter
from importlib import import_module
from pathlib import Path
import re
import sys
from xml.etree import ElementTree

import pytest

SRC = Path(__file__).resolve().parents[2]
# packages may import packages to their left
ORDER = ("uwb_tdoa_msgs", "uwb_tdoa_bias", "uwb_tdoa_ekf", "uwb_tdoa_tools")
PACKAGES = ORDER[1:]
# the public module, which a package installs in addition to its own
API = {"uwb_tdoa_tools": ("uwb_tdoa",)}
# Modules that use ROS. All others can be imported and tested without it.
ROS = """
    uwb_tdoa_bias.anchors_node uwb_tdoa_bias.bias_node
    uwb_tdoa_bias.ros.node uwb_tdoa_bias.ros.anchors uwb_tdoa_bias.ros.cdr
    uwb_tdoa_bias.ros.diagnostics uwb_tdoa_bias.ros.frames uwb_tdoa_bias.ros.node
    uwb_tdoa_bias.ros.parameters
    uwb_tdoa_bias.ros.node uwb_tdoa_bias.ros.topics uwb_tdoa_bias.ros.node
    uwb_tdoa_bias.ros.topics
    uwb_tdoa_ekf.debias_node uwb_tdoa_ekf.ekf_node uwb_tdoa_ekf.ekf_parameters
    uwb_tdoa_ekf.launching
    uwb_tdoa_ekf.launching_actions uwb_tdoa_ekf.localization_node uwb_tdoa_ekf.outputs
    uwb_tdoa_ekf.monitoring.health
    uwb_tdoa_tools.autopilot.topics uwb_tdoa_tools.autopilot_node
    uwb_tdoa_tools.flying.demo uwb_tdoa_tools.live.session uwb_tdoa_tools.live.follow
    uwb_tdoa_tools.live.processes uwb_tdoa_tools.live.record uwb_tdoa_tools.live.replay
    uwb_tdoa_tools.flying.over_topics uwb_tdoa_tools.live.run uwb_tdoa_tools.live.session uwb_tdoa_tools.vehicle_node
""".split()
IS_ROS = re.compile(r"rclpy|\w+_msgs|\w+_interfaces|domain_coordinator|ament_index_python")
# import name: (rosdep key, name on the Python package index)
# ROS packages are imported under their own name
KEYS = {
    "backports": (None, "backports.zstd"),  # installed with rosbags, like lz4
    "cflib": (None, "cflib"),  # for protocol crazyflie
    "dask": (None, "distributed"),
    "distributed": (None, "distributed"),
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
    "pyulog": (None, "pyulog"),  # for logs of PX4
    "rerun": (None, "rerun-sdk"),  # for --rerun
    "rosbags": ("python3-rosbags-pip", "rosbags"),
    "pandas": (None, "pandas"),  # optional, for tables
    "rotorpy": (None, "rotorpy"),  # optional, a reference for tests
    "scipy": ("python3-scipy", "scipy"),
    "sklearn": ("python3-sklearn", "scikit-learn"),
    "tqdm": ("python3-tqdm", "tqdm"),
    "yaml": ("python3-yaml", "PyYAML"),
}
# programs that launch files start, and the launch system
STARTED = {"uwb_tdoa_ekf": {"ros2bag", "ros2launch", "rviz2"}}
# needed to run the tests, but not imported
RUNNERS = {"python3-pytest-xdist"}


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
    """Return the imports of a module: full names of our modules, and top-level names of others."""
    path = modules()[module]
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    found = set()
    for node in statements(path)[top_only]:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        else:
            base = (
                ".".join(package.split(".")[: len(package.split(".")) + 1 - node.level])
                if node.level
                else ""
            )
            base = ".".join(part for part in (base, node.module) if part)
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                found.add(inner if inner in modules() else base)
    return frozenset(found)


def ours(module, top_only=False):
    return {name for name in imports(module, top_only) if name in modules()}


COMMANDS = [name for name in modules() if re.match(r"uwb_tdoa_tools\.commands\.[a-z]", name)]


def test_relative_imports_lead_to_modules():
    """Imports in functions count, too. They fail only when the function runs."""
    for module, path in modules().items():
        package = module if path.name == "__init__.py" else module.rpartition(".")[0]
        for node in statements(path)[0]:
            if isinstance(node, ast.ImportFrom) and node.level:
                parts = package.split(".")[: len(package.split(".")) + 1 - node.level]
                assert ".".join([*parts, *filter(None, [node.module])]) in modules(), (
                    f"{module}: line {node.lineno}"
                )


def test_no_module_imports_a_command():
    for module in modules():
        commands = [name for name in imports(module) if ".commands" in name]
        assert not commands, module


def test_what_takes_a_second_to_import_is_imported_where_it_is_used():
    """Modules that take a second to import are imported in functions."""
    slow = {"scipy.stats", "scipy.signal"}
    for module in modules():
        found = imports(module, top_only=True)
        assert not found & slow, module
        if module.startswith(("uwb_tdoa_tools.evaluating", "uwb_tdoa_tools.localizing")):
            assert not [name for name in found if ".diagnosis" in name], module


def test_no_package_imports_one_above():
    for module in modules():
        for name in imports(module):
            package, own = name.partition(".")[0], module.partition(".")[0]
            assert own == "uwb_tdoa" or package != "uwb_tdoa", f"{module} imports {name}"
            if package in ORDER and own in ORDER:
                assert ORDER.index(package) <= ORDER.index(own), f"{module} imports {name}"


def test_files_are_on_floors():
    """Imports between files form no cycle, neither at run time nor for types."""
    TopologicalSorter(
        {module: ours(module) - {module} for module in modules()}
    ).prepare()  # raises CycleError, which names the cycle


def test_folders_are_on_floors():
    """Imports between folders form no cycle."""
    needs = {}
    for module in modules():
        folder = folder_of(module)
        needs.setdefault(folder, set()).update(map(folder_of, ours(module)))
    needs.pop("")
    TopologicalSorter({folder: others - {folder, ""} for folder, others in needs.items()}).prepare()


def folder_of(module):
    """Return package.folder of a module or package, at any depth below; "" without a folder."""
    parts = module.split(".")
    return ".".join(parts[:2]) if (SRC / parts[0] / Path(*parts[:2])).is_dir() else ""


def test_the_common_types_stand_alone():
    for module in modules():
        if module.startswith("uwb_tdoa_bias.common"):
            for name in ours(module):
                assert name.startswith("uwb_tdoa_bias.common"), f"{module} imports {name}"


def test_nothing_imports_studies_and_they_import_no_command():
    files, studies = list(SRC.rglob("*.py")), list((SRC.parent / "studies").rglob("*.py"))
    assert len(files) > 500 and len(studies) > 40
    for path in files:
        assert not re.search(r"^\s*(from|import) studies\b", path.read_text(), re.MULTILINE), path
    for path in studies:
        assert not re.search(
            r"^\s*(from|import) uwb_tdoa_tools\.commands\b", path.read_text(), re.MULTILINE
        ), path
    for package in PACKAGES:
        assert "studies" not in (SRC / package / "setup.py").read_text()


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


@pytest.mark.parametrize("module", modules())
def test_ros_is_imported_by_those_who_talk_it_and_nobody_else(module):
    assert bool(way_to_ros(module)) == (module in ROS), way_to_ros(module) or "needs no ROS"


def names_of_messages(package):
    """Return the packages of message types that are named in strings and imported at run time."""
    texts = "".join(
        path.read_text() for path in modules().values() if path.is_relative_to(SRC / package)
    )
    return set(re.findall(r'"(\w+)/msg/\w+"', texts)) - {"pkg", package}  # from a docstring


@cache
def needed(package, *folders):
    """Return the external packages that the files in some folders of a package import.

    Our packages and the standard library do not count.
    """
    names = set()
    for folder in (*folders, *(API.get(package, ()) if package in folders else ())):
        local = (
            {path.stem for path in (SRC / package / folder).rglob("*.py")}
            if folder not in (package, *API.get(package, ()))
            else set()
        )
        for path in (SRC / package / folder).rglob("*.py"):
            for node in statements(path)[0]:
                if isinstance(node, ast.Import):
                    names |= {alias.name.partition(".")[0] for alias in node.names}
                elif isinstance(node, ast.ImportFrom) and not node.level:
                    names.add(node.module.partition(".")[0])
        names -= local
    beside = {
        path.stem for other in PACKAGES for path in (SRC / other / "test").iterdir()
    }  # test helpers
    return (
        names
        - set(sys.stdlib_module_names)
        - beside
        - {package, *API.get(package, ()), "setuptools", "compression"}
    )


def declared(package, *tags):
    root = ElementTree.parse(SRC / package / "package.xml").getroot()
    return {element.text for tag in tags for element in root.iter(tag)}


def keys(names):
    return {KEYS[name][0] if name in KEYS else name for name in names} - {None}


@pytest.mark.parametrize("package", PACKAGES)
def test_package_xml_declares_what_is_imported_and_nothing_else(package):
    used = keys(needed(package, package, "launch") | names_of_messages(package))
    assert declared(package, "depend", "exec_depend") == used | STARTED.get(package, set())
    tests = keys(needed(package, "test")) - used
    assert declared(package, "test_depend") - RUNNERS == tests


def test_pyproject_declares_what_is_imported_and_nothing_else():
    _, text = (SRC.parent / "pyproject.toml").read_text().split("\ndependencies =")
    text = "dependencies =" + text.partition("[project.scripts]")[0]
    lists = re.findall(r"^\w+ = (\[.*?\])(?: #[^\n]*)?$", text, re.MULTILINE | re.DOTALL)
    names = [re.match(r"[\w.-]+", one)[0] for some in lists for one in ast.literal_eval(some)]
    assert len(names) == len(set(names))
    imported = set().union(*(needed(package, package) for package in PACKAGES))
    tested = {"rotorpy"} & needed("uwb_tdoa_tools", "test")  # tests without it are skipped
    assert set(names) == {KEYS[name][1] for name in (imported | tested) if name in KEYS}


def test_messages_declare_what_they_are_made_of():
    texts = "".join(path.read_text() for path in (SRC / "uwb_tdoa_msgs").glob("*/*"))
    assert declared("uwb_tdoa_msgs", "depend") == set(
        re.findall(r"^(\w+)/\w+", texts, flags=re.MULTILINE)
    )


@pytest.mark.parametrize("package", PACKAGES)
def test_every_executable_starts_behind_an_entry_point_of_its_name(package):
    text = (SRC / package / "setup.py").read_text()
    points = re.findall(r'"(\w+) = ([\w.]+):(\w+)"', text)
    assert points
    started = import_module(f"{package}.executables")
    entries = {name: getattr(started, name).args[0] for name, _, _ in points}
    for name, module, attribute in points:
        assert (module, attribute) == (f"{package}.executables", name)
        assert entries[name] in modules() and entries[name].rpartition(".")[2] == name
    if package == "uwb_tdoa_tools":
        commands = set(COMMANDS)
        assert set(entries.values()) == commands | {
            "uwb_tdoa_tools.autopilot_node",
            "uwb_tdoa_tools.vehicle_node",
        }


@pytest.mark.parametrize("module", COMMANDS)
def test_commands_are_thin(module):
    text = modules()[module].read_text()
    body = ast.parse(text).body
    functions = {node.name for node in body if isinstance(node, ast.FunctionDef)}
    assert "parser" in functions and re.search(r"\nmain = cli.executable\(.*\)\n$", text)
    parser = next(
        node for node in body if isinstance(node, ast.FunctionDef) and node.name == "parser"
    )
    options = [node for node in ast.walk(parser) if isinstance(node, ast.stmt)]
    statements = [
        node
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.stmt) and not isinstance(node, (ast.Import, ast.ImportFrom))
    ]
    assert len(statements) - len(options) <= 65
    assert not re.search(
        r"(?<!\w)print\(|tqdm\.write", text
    )  # cli.show and cli.say escape unprintable text from others
