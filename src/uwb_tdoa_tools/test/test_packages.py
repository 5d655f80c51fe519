# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Package files: one version everywhere, valid by REP 149, and all that a package installs."""

import re
import runpy
from xml.etree import ElementTree

from documented import ROOT
import pytest
import setuptools
import yaml

from uwb_tdoa_bias.common.errors import version, written_by

PACKAGES = sorted(path.parent for path in (ROOT / "src").glob("*/package.xml"))
PYTHON = [folder for folder in PACKAGES if (folder / "setup.py").exists()]


@pytest.mark.parametrize("folder", PACKAGES, ids=lambda folder: folder.name)
def test_package_xml_and_changelog_are_read_by_catkin(folder):
    """The version replaces "Forthcoming", as after catkin_prepare_release."""
    package = pytest.importorskip("catkin_pkg.package")
    changelog = pytest.importorskip("catkin_pkg.changelog")
    remarks = []
    parsed = package.parse_package(folder / "package.xml", warnings=remarks)
    assert remarks == [] and parsed.package_format == 3 and parsed.licenses == ["Apache-2.0"]
    released = f"{version()} (2026-01-01)"
    text = (folder / "CHANGELOG.rst").read_text()
    text = text.replace("Forthcoming\n-----------", f"{released}\n{'-' * len(released)}")
    found = changelog.Changelog(folder.name)
    changelog.populate_changelog_from_rst(found, text)
    assert found.get_content_of_version(version())


@pytest.mark.parametrize("folder", PYTHON, ids=lambda folder: folder.name)
def test_setup_installs_models_and_templates_and_has_tests(folder, monkeypatch):
    """colcon searches for tests by its own rule."""
    kept = {}
    monkeypatch.chdir(folder)
    monkeypatch.setattr(setuptools, "setup", lambda **given: kept.update(given))
    runpy.run_path("setup.py")
    assert kept["version"] == version() and "pytest" in str(kept["extras_require"])
    package = folder / folder.name
    patterns = kept.get("package_data", {}).get(folder.name, [])
    files = {path for path in package.rglob("[!.]*.*") if path.suffix not in (".py", ".pyc")}
    files = {path for path in files if not path.parent.name.startswith(".")}
    assert files == {path for pattern in patterns for path in package.glob(pattern)}


def test_one_version_everywhere():
    found = {ElementTree.parse(folder / "package.xml").findtext("version") for folder in PACKAGES}
    found.add(yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"])
    found.add(re.search(r"^## ([\d.]+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1])
    assert found == {version()} and written_by() == f"uwb_tdoa {version()}"


def locked(name):
    """Return {package: version} of a lock. Each has a hash."""
    text = (ROOT / name).read_text()
    found = dict(re.findall(r"^([^\s=]+)==(\S+)", text, re.M))
    assert len(re.findall(r"^\S+==\S+ \\\n    --hash=sha256:", text, re.M)) == len(found)
    return found


def test_what_leads_to_other_machines_is_locked():
    """Every optional package that has a link, and all that it needs, in the versions of the rest."""
    optional, rest = locked(".dev/optional.lock"), locked(".dev/requirements.lock")
    extras = (ROOT / "pyproject.toml").read_text().partition("[project.optional-dependencies]")[2]
    for extra in ("crazyflie", "mavlink"):
        (line,) = re.findall(rf"^{extra} = .*", extras, re.M)
        assert {*re.findall(r'"([a-z]+)>=', line)} <= optional.keys()
    (other,) = {name for name in optional.keys() & rest if optional[name] != rest[name]}
    assert other == "packaging"  # cflib needs an older one
    for name, number in locked(".ci/requirements.lock").items():
        assert optional.get(name, number) == number or name == "packaging"


def test_who_runs_the_container_owns_none_of_its_code():
    lines = (ROOT / "Containerfile").read_text().splitlines()
    code = [k for k, line in enumerate(lines) if re.search(r"^COPY|^RUN .*build|^USER", line)]
    assert lines[code[-1]] == "USER uwb" and sum("USER" in lines[k] for k in code) == 1
    assert not any("chown" in line or "chmod" in line for line in lines)
