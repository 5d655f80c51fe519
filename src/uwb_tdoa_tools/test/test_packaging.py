# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Package files: one version everywhere, known rosdep keys, and tests that colcon finds."""

import json
from pathlib import Path
import re
import subprocess
import sys
from xml.etree import ElementTree

from documented import ROOT
import pytest
import yaml

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.survey import read_survey
from uwb_tdoa_bias.common.text import version, written_by
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools import cli

PACKAGES = sorted(path.parent for path in (ROOT / "src").glob("*/package.xml"))
PYTHON = [folder for folder in PACKAGES if (folder / "setup.py").exists()]


def test_one_version_everywhere():
    found = {ElementTree.parse(folder / "package.xml").findtext("version") for folder in PACKAGES}
    found |= {setup_of(folder, "version")["version"] for folder in PYTHON}
    found.add(yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"])
    found.add(re.search(r"^## ([\d.]+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1])
    assert found == {version()}
    assert written_by() == f"uwb_tdoa {version()}"


def test_what_is_written_names_the_version(tmp_path):
    Anchors.from_positions([[0, 0, 0], [1, 0, 0]]).to_yaml(tmp_path / "anchors.yaml")
    EffectSet().to_yaml(tmp_path / "effects.yaml")
    cli.write_json(tmp_path / "figures.json", {"a": 1})
    for name in ("anchors.yaml", "effects.yaml", "figures.json"):
        assert written_by() in (tmp_path / name).read_text()
    assert json.loads((tmp_path / "figures.json").read_text()) == {
        "written_by": written_by(),
        "a": 1,
    }
    assert len(read_survey(tmp_path / "anchors.yaml")) == 2
    assert EffectSet.from_yaml(tmp_path / "effects.yaml").effects == ()


def test_the_version_is_an_option(capsys):
    assert cli.run(lambda args: 0, cli.parser("convert", "Convert."), ["--version"]) == 0
    assert capsys.readouterr().out == f"convert of {written_by()}\n"


def test_package_files_are_valid():
    """The rules of REP 149 apply, as in ament and rosdep."""
    package = pytest.importorskip("catkin_pkg.package")
    for folder in PACKAGES:
        remarks = []
        parsed = package.parse_package(folder / "package.xml", warnings=remarks)
        assert remarks == [] and parsed.package_format == 3 and parsed.licenses == ["Apache-2.0"]


def declared():
    """Return the names of all dependencies in all package.xml, without our packages."""
    tags = ("depend", "exec_depend", "test_depend", "build_depend", "buildtool_depend")
    roots = [ElementTree.parse(folder / "package.xml").getroot() for folder in PACKAGES]
    return {element.text for root in roots for tag in tags for element in root.iter(tag)} - {
        p.name for p in PACKAGES
    }


def test_rosdep_knows_what_is_declared():
    listed = yaml.safe_load((ROOT / ".ci" / "rosdep_keys.yaml").read_text())
    assert declared() == {*listed["apt"], *listed["pip"], *listed["ros"]}
    assert all(key.endswith("-pip") for key in listed["pip"])


def container():
    """Return [(instruction, rest)] of the Containerfile, with continued lines joined."""
    text = re.sub(r"\\\n\s*", " ", (ROOT / "Containerfile").read_text())
    return [
        line.split(maxsplit=1) for line in text.splitlines() if line and not line.startswith("#")
    ]


def test_the_container_has_what_it_copies_and_calls():
    steps = container()
    assert steps[0] == ["FROM", "ros:jazzy"] and steps[1] == ["SHELL", '["/bin/bash", "-c"]']
    assert {word for word, _ in steps} <= {
        "FROM",
        "SHELL",
        "WORKDIR",
        "COPY",
        "ENV",
        "RUN",
        "USER",
        "CMD",
    }
    for word, rest in steps:
        if word == "COPY":
            assert all((ROOT / name).exists() for name in rest.split()[:-1])
        elif word == "RUN":  # only the syntax: the command does not run
            assert subprocess.run(["bash", "-n", "-c", rest], capture_output=True).stderr == b""
    ros2, launch, package, file = json.loads(dict(steps)["CMD"])
    assert (ros2, launch) == ("ros2", "launch") and (
        ROOT / "src" / package / "launch" / file
    ).is_file()


def test_the_container_installs_what_is_declared():
    steps = container()
    install, build = (
        next(rest for word, rest in steps if word == "RUN" and key in rest)
        for key in ("rosdep", "colcon")
    )
    assert (
        "rosdep install --from-paths src --ignore-src -y --rosdistro jazzy" in install
        and "colcon build" in build
    )
    assert (
        install.index("rosdep update")
        < install.index("rosdep install")
        < install.index("pip install")
    )
    assert install.index("pip_constraint.txt") < install.index(
        "rosdep install"
    )  # before pip reads it
    (variables,) = (rest for word, rest in steps if word == "ENV")
    assert (
        f"PIP_CONSTRAINT={dict(steps)['WORKDIR']}/pip_constraint.txt" in variables
        and "PIP_BREAK_SYSTEM_PACKAGES=1" in variables
    )
    without_key = set(re.findall(r"pip install --no-cache-dir ([\w ]+)", install)[0].split())
    pinned = {
        line.partition("==")[0]
        for line in (ROOT / "requirements.txt").read_text().splitlines()
        if "==" in line
    }
    assert (
        without_key == {"onnx"} and without_key <= pinned
    )  # the only import without a rosdep key (test_layout.py)
    order = [word for word, _ in steps]
    assert order.index("COPY") < order.index("RUN") and order[-1] == "CMD"


def test_the_container_runs_as_an_ordinary_user_beside_the_host_and_with_pins():
    steps, first = container(), (ROOT / "Containerfile").read_text().splitlines()[0]
    order = [word for word, _ in steps]
    (user,) = (rest for word, rest in steps if word == "USER")
    assert user != "root" and any(
        f"useradd --create-home {user}" in rest for word, rest in steps if word == "RUN"
    )
    after = steps[order.index("USER") + 1 :]
    assert [word for word, _ in after] == ["RUN", "CMD"] and "compile_nodes" in after[0][
        1
    ]  # the user owns the compiled code
    assert "podman run" in first and "--net" not in first
    chosen = next(
        re.search(r'grep -E "(.*?)" requirements.txt', rest)[1]
        for word, rest in steps
        if "pip_constraint.txt" in rest and word == "RUN"
    )
    assert [
        line.split("==")[0]
        for line in (ROOT / "requirements.txt").read_text().splitlines()
        if re.match(chosen, line)
    ] == [
        "onnxruntime",
        "rosbags",
        "onnx",
    ]


def setup_of(folder, *names):
    """Return {name: value} of some names in setup.py of a package."""
    code = (
        f"import json, runpy, setuptools; kept = {{}}; setuptools.setup = kept.update; "
        f"runpy.run_path('setup.py'); names = {names}; "
    )
    code += "print(json.dumps({name: kept.get(name, {}) for name in names}))"
    return json.loads(
        subprocess.run(
            [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True
        ).stdout
    )


@pytest.mark.parametrize("folder", PYTHON, ids=lambda folder: folder.name)
def test_colcon_finds_tests(folder):
    """colcon searches for tests by its own rule, on the content of setup.py."""
    rule = pytest.importorskip("colcon_core.task.python.test")
    assert rule.has_test_dependency(setup_of(folder, "extras_require"), "pytest")


@pytest.mark.parametrize("folder", PYTHON, ids=lambda folder: folder.name)
def test_models_and_templates_are_installed_too(folder):
    package = folder / folder.name
    patterns = setup_of(folder, "package_data")["package_data"].get(folder.name, [])
    given = {path for pattern in patterns for path in package.glob(pattern)}
    assert {
        path
        for path in package.rglob("[!.]*.*")
        if path.suffix not in (".py", ".pyc") and not path.parent.name.startswith(".")
    } == given


def test_colcon_sees_the_packages_below_the_pyproject_of_all(tmp_path):
    pytest.importorskip("colcon_core")
    words = [sys.executable, "-m", "colcon", "--log-base", tmp_path / "log", "list", "--names-only"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.split() == [folder.name for folder in PACKAGES], done.stderr


@pytest.mark.slow
def test_colcon_test_runs_what_pytest_runs(tmp_path):
    pytest.importorskip("colcon_core")
    if not (ROOT / "build" / "uwb_tdoa_bias").is_dir():
        pytest.skip("the workspace is not built here")
    names = ["test_stamps.py", "test_geometry.py"]
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "colcon",
            "--log-base",
            tmp_path / "log",
            "test",
            "--merge-install",
            "--packages-select",
            "uwb_tdoa_bias",
            "--test-result-base",
            tmp_path / "result",
            "--pytest-args",
            *[f"test/{name}" for name in names],
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    (result,) = Path(tmp_path / "result").rglob("pytest.xml")
    counted = int(next(ElementTree.parse(result).getroot().iter("testsuite")).get("tests"))
    files = [ROOT / "src" / "uwb_tdoa_bias" / "test" / name for name in names]
    told = subprocess.run(
        [sys.executable, "-m", "pytest", "--collect-only", "-q", *files],
        cwd=ROOT,
        capture_output=True,
        text=True,
    ).stdout
    assert counted == int(re.search(r"(\d+)(?:/\d+)? tests? collected", told)[1]) > 0
