"""mypy, where it is installed, as .ci/mypy.ini says: the annotations of uwb_tdoa_bias."""

import pytest

from documented import ROOT

WRONG = "from uwb_tdoa_bias.foundation.version import version; version() + 1"


@pytest.mark.slow
def test_annotations(monkeypatch):
    run = pytest.importorskip("mypy.api").run
    monkeypatch.chdir(ROOT)
    report, failure, code = run(["--config-file", ".ci/mypy.ini", "-p", "uwb_tdoa_bias"])
    assert code == 0, report + failure
    report, failure, code = run(["--config-file", ".ci/mypy.ini", "-c", WRONG])
    assert code == 1 and "[operator]" in report, report + failure
