# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Requirements of a release to the ROS index: changelogs, and Debian packages by bloom."""

import gzip
import os
import shutil
import subprocess
import sys
from xml.etree import ElementTree

from documented import ROOT
import pytest
from test_distribution import run
import yaml

from uwb_tdoa_bias.common.text import version

LICENCE = "# SPDX-License-Identifier: Apache-2.0\n"
PACKAGES = sorted(path.parent for path in (ROOT / "src").glob("*/package.xml"))


@pytest.mark.parametrize("folder", PACKAGES, ids=lambda folder: folder.name)
def test_each_package_has_a_changelog_that_catkin_reads(folder):
    """The version replaces "Forthcoming", as after catkin_prepare_release."""
    changelog = pytest.importorskip("catkin_pkg.changelog")
    text = (folder / "CHANGELOG.rst").read_text()
    assert f"Changelog for package {folder.name}\n" in text
    released = f"{version()} (2026-01-01)"
    text = text.replace("Forthcoming\n-----------", f"{released}\n{'-' * len(released)}")
    found = changelog.Changelog(folder.name)
    changelog.populate_changelog_from_rst(found, text)
    assert found.get_content_of_version(version())


def test_each_source_names_its_licence():
    """Empty files need no licence."""
    files = [path for path in (ROOT / "src").rglob("*.py") if path.stat().st_size]
    without = [str(path) for path in files if LICENCE not in path.read_text()[:200]]
    assert len(files) > 300 and not without


@pytest.fixture(scope="module")
def bloom(tmp_path_factory):
    """Return environment variables for bloom with a local index of our dependencies."""
    folder = tmp_path_factory.mktemp("bloom")
    run(sys.executable, "-m", "venv", folder / "venv")
    run(folder / "venv" / "bin" / "python", "-m", "pip", "install", "bloom")
    keys = yaml.safe_load((ROOT / ".ci" / "rosdep_keys.yaml").read_text())
    names = [*keys["ros"], *(package.name for package in PACKAGES)]
    release = {
        "tags": {"release": "release/jazzy/{package}/{version}"},
        "url": "https://example.invalid/release.git",
        "version": "1.0.0-1",
    }
    distribution = {
        "release_platforms": {"ubuntu": ["noble"]},
        "repositories": {name: {"release": release} for name in names},
        "type": "distribution",
        "version": 2,
    }
    cache = {
        "distribution_file": [distribution],
        "name": "jazzy",
        "release_package_xmls": {},
        "source_repo_package_xmls": {},
        "type": "cache",
        "version": 2,
    }
    jazzy = {
        "distribution": ["distribution.yaml"],
        "distribution_cache": f"file://{folder}/cache.yaml.gz",
        "distribution_status": "active",
        "distribution_type": "ros2",
        "python_version": 3,
    }
    index = {"distributions": {"jazzy": jazzy}, "type": "index", "version": 4}
    database = {key: {"ubuntu": [name]} for key, name in keys["apt"].items()}
    database |= {
        key: {"ubuntu": {"pip": {"packages": [name]}}} for key, name in keys["pip"].items()
    }
    for name, content in (
        ("index.yaml", index),
        ("distribution.yaml", distribution),
        ("base.yaml", database),
    ):
        (folder / name).write_text(yaml.safe_dump(content))
    with gzip.open(folder / "cache.yaml.gz", "wt") as file:
        file.write(yaml.safe_dump(cache))
    (folder / "sources").mkdir()
    (folder / "sources" / "20-ours.list").write_text(f"yaml file://{folder}/base.yaml\n")
    variables = {
        "PATH": f"{folder / 'venv' / 'bin'}:{os.environ['PATH']}",
        "ROSDISTRO_INDEX_URL": f"file://{folder}/index.yaml",
        "ROSDEP_SOURCE_PATH": str(folder / "sources"),
        "ROS_HOME": str(folder / "home"),
        "ROS_VERSION": "2",
    }
    run("rosdep", "update", "--rosdistro", "jazzy", folder=folder, **variables)
    return variables


@pytest.mark.slow
def test_bloom_makes_a_debian_package_of_each(bloom, tmp_path):
    """A pip key becomes the name of a Debian package that does not exist: docs/release.md."""
    shutil.copytree(ROOT / "src", tmp_path / "src", ignore=shutil.ignore_patterns("__pycache__"))
    depends = {}
    for package in PACKAGES:
        folder = tmp_path / "src" / package.name
        subprocess.run(["git", "init", "--quiet", folder], check=True)
        words = "--os-name ubuntu --os-version noble --ros-distro jazzy".split()
        run("bloom-generate", "rosdebian", *words, ".", folder=folder, **bloom)
        control = (folder / "debian" / "control").read_text()
        assert f"Source: ros-jazzy-{package.name.replace('_', '-')}\n" in control
        lines = [line for line in control.splitlines() if line.startswith("Depends:")]
        depends[package.name] = set(lines[0].removeprefix("Depends: ").split(", "))
        declared = ElementTree.parse(package / "package.xml").getroot()
        names = {
            element.text for tag in ("depend", "exec_depend") for element in declared.iter(tag)
        }
        ours = {f"ros-jazzy-{name.replace('_', '-')}" for name in names if "uwb_tdoa" in name}
        assert ours <= depends[package.name]
    assert "onnxruntime" in depends["uwb_tdoa_bias"] and "rosbags" in depends["uwb_tdoa_tools"]
