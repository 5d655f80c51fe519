"""One version everywhere, in what is written too; keys that rosdep knows; and what colcon test would run."""

import json
from pathlib import Path
import re
import subprocess
import sys
from xml.etree import ElementTree

from documented import ROOT
import pytest
import yaml

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.version import version, written_by
from uwb_tdoa_tools import cli

PACKAGES = sorted(path.parent for path in (ROOT / "src").glob("*/package.xml"))
PYTHON = [folder for folder in PACKAGES if (folder / "setup.py").exists()]


def test_one_version_everywhere():
    found = {ElementTree.parse(folder / "package.xml").findtext("version") for folder in PACKAGES}
    found |= {re.search(r'version="([^"]+)"', (folder / "setup.py").read_text())[1] for folder in PYTHON}
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
    assert json.loads((tmp_path / "figures.json").read_text()) == {"written_by": written_by(), "a": 1}
    assert len(Anchors.from_yaml(tmp_path / "anchors.yaml")) == 2
    assert EffectSet.from_yaml(tmp_path / "effects.yaml").effects == ()


def test_the_version_is_an_option(capsys):
    assert cli.run(lambda args: 0, cli.parser("convert", "Convert."), ["--version"]) == 0
    assert capsys.readouterr().out == f"convert of {written_by()}\n"


def test_package_files_are_valid():
    """By the rules of REP 149, as ament and rosdep read them."""
    package = pytest.importorskip("catkin_pkg.package")
    for folder in PACKAGES:
        remarks = []
        parsed = package.parse_package(folder / "package.xml", warnings=remarks)
        assert remarks == [] and parsed.package_format == 3 and parsed.licenses == ["Apache-2.0"]


def declared():
    """Names of all dependencies in all package.xml, our packages aside."""
    tags = ("depend", "exec_depend", "test_depend", "build_depend", "buildtool_depend")
    roots = [ElementTree.parse(folder / "package.xml").getroot() for folder in PACKAGES]
    return {element.text for root in roots for tag in tags for element in root.iter(tag)} - {p.name for p in PACKAGES}


def test_rosdep_knows_what_is_declared():
    listed = yaml.safe_load((ROOT / ".ci" / "rosdep_keys.yaml").read_text())
    assert declared() == {*listed["apt"], *listed["pip"], *listed["ros"]}
    assert all(key.endswith("-pip") for key in listed["pip"])


def test_the_container_installs_what_is_declared():
    text = (ROOT / "Containerfile").read_text()
    for source in re.findall(r"^COPY (.+) \S+$", text, re.MULTILINE):
        assert all((ROOT / name).exists() for name in source.split())
    assert "FROM ros:jazzy" in text and "rosdep install --from-paths src" in text
    assert (ROOT / "src/uwb_tdoa_ekf/launch" / re.search(r'"(\w+\.launch\.py)"', text)[1]).exists()


@pytest.mark.parametrize("folder", PYTHON, ids=lambda folder: folder.name)
def test_colcon_finds_tests(folder):
    """By the rule of colcon itself, on what setup.py says."""
    rule = pytest.importorskip("colcon_core.task.python.test")
    code = "import json, runpy, setuptools; kept = {}; setuptools.setup = kept.update; "
    code += "runpy.run_path('setup.py'); print(json.dumps(kept.get('extras_require', {})))"
    told = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True).stdout
    assert rule.has_test_dependency({"extras_require": json.loads(told)}, "pytest")


@pytest.mark.slow
def test_colcon_test_runs_what_pytest_runs(tmp_path):
    pytest.importorskip("colcon_core")
    if not (ROOT / "build" / "uwb_tdoa_bias").is_dir():
        pytest.skip("the workspace is not built here")
    names = ["test_effects_wording.py", "test_geometry.py"]
    done = subprocess.run(
        [
            sys.executable, "-m", "colcon", "--log-base", tmp_path / "log", "test", "--merge-install",
            "--packages-select", "uwb_tdoa_bias", "--test-result-base", tmp_path / "result",
            "--pytest-args", *[f"test/{name}" for name in names],
        ],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (result,) = Path(tmp_path / "result").rglob("pytest.xml")
    counted = int(next(ElementTree.parse(result).getroot().iter("testsuite")).get("tests"))
    files = [ROOT / "src" / "uwb_tdoa_bias" / "test" / name for name in names]
    told = subprocess.run(
        [sys.executable, "-m", "pytest", "--collect-only", "-q", *files], cwd=ROOT, capture_output=True, text=True
    ).stdout
    assert counted == int(re.search(r"(\d+)(?:/\d+)? tests? collected", told)[1]) > 0
