"""mypy, where it is installed, as .ci/mypy.ini says: the annotations of the packages and folders
that it names.
"""

import configparser

from documented import ROOT
import pytest

WRONG = "from uwb_tdoa_bias.common.text import version; version() + 1"


def annotated():
    """Names of the packages and folders whose functions must have annotations."""
    found = configparser.ConfigParser()
    found.read(ROOT / ".ci/mypy.ini")
    sections = (
        name for name in found.sections() if found[name].getboolean("disallow_untyped_defs", False)
    )
    return [name.removeprefix("mypy-").removesuffix(".*") for name in sections]


@pytest.mark.slow
def test_annotations(monkeypatch):
    run = pytest.importorskip("mypy.api").run
    monkeypatch.chdir(ROOT)
    assert {"uwb_tdoa_bias", "uwb_tdoa_ekf", "uwb_tdoa_tools"} <= set(annotated())
    packages = [word for name in annotated() for word in ("-p", name)]
    report, failure, code = run(["--config-file", ".ci/mypy.ini", *packages])
    assert code == 0, report + failure
    report, failure, code = run(["--config-file", ".ci/mypy.ini", "-c", WRONG])
    assert code == 1 and "[operator]" in report, report + failure
