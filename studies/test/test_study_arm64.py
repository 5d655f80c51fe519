# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The comparison with 64-bit Arm, without an emulator."""

from dataclasses import replace
import json
from types import SimpleNamespace

import numpy as np
import pytest

from studies import arm64, arm64_estimates
from studies.__main__ import main
from uwb_tdoa_bias.correction import trial


def test_missing_programs_are_named_by_their_packages(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main(["arm64", "--folder", str(tmp_path / "arm64")]) == 2
    assert "needs Debian's packages qemu-user-static, apt, dpkg; install" in capsys.readouterr().err
    assert not (tmp_path / "arm64").exists()


def test_a_flight_that_is_not_there_is_one_sentence(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(arm64, "PROGRAMS", {})
    words = ["arm64", "--folder", str(tmp_path), "--flights", str(tmp_path / "none.log")]
    assert main(words) == 2
    assert "none.log: does not exist" in capsys.readouterr().err


def test_wheels_are_those_of_the_lock_with_all_that_they_need():
    lock = (arm64.ROOT / ".dev/requirements.lock").read_text()
    lines = arm64.pinned(lock).splitlines()
    names = {line.partition("==")[0] for line in lines if line[0].isalpha()}
    assert {"numpy", "numba", "llvmlite", "pyyaml", "protobuf", "backports-zstd"} <= names
    assert not any(name.startswith("ros-") for name in names)
    assert set(lines) <= set(lock.splitlines())
    assert sum("--hash=sha256:" in line for line in lines) > len(names)


NAN = float("nan")


@pytest.mark.parametrize(
    ("one", "other", "differing", "largest"),
    [
        ([1.0, NAN, 0.0], [1.0, NAN, 0.0], 0, 0.0),
        ([1.0, 2.0], [1.0, np.nextafter(2.0, 3.0)], 1, 2.0**-51),
        ([0.0, 1.0], [-0.0, 1.0], 1, 0.0),
        ([1.0, NAN], [1.0, 2.0], 1, np.inf),
        ([1, 2, 3], [1, 5, 3], 1, 3.0),
        ([1.0, 2.0], [1.0], 2, np.inf),
        ([1.0, 2.0], None, 2, np.inf),
    ],
)
def test_values_are_compared_by_their_bits(one, other, differing, largest):
    sides = [{} if x is None else {"flight: p": np.array(x)} for x in (one, other)]
    for here, there in (sides, sides[::-1]):
        (row,) = arm64.compared(here, there)
        assert (row["differing"], row["largest"]) == (differing, largest)
        lines = list(arm64.table([row]))
        assert len(lines) == 3 + (differing > 0) and lines[2].startswith("| flight | 1 |")


@pytest.mark.slow
def test_the_cases_are_what_estimates_are_made_of(tmp_path, monkeypatch):
    """Without an emulator: twice by this Python. A changed recording differs."""
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setattr(trial, "tried_out", arm64_estimates.tried_out)
    monkeypatch.setattr(arm64, "FLIGHT", replace(arm64.FLIGHT, duration=16.0))
    known = arm64.cases(tmp_path, SimpleNamespace(flights=[], survey=None))
    files = [tmp_path / name for name in ("one.npz", "other.npz")]
    for part, path in zip((known, dict(list(known.items())[:1])), files):
        (tmp_path / "cases.json").write_text(json.dumps(part))
        arm64_estimates.main(tmp_path / "cases.json", path)
    one, other = (dict(np.load(path)) for path in files)
    assert len(known) == 3 and {name.partition(": ")[0] for name in one} == set(known)
    rows = arm64.compared({name: one[name] for name in other}, other)
    assert not any(row["differing"] for row in rows)
    assert {"simulated: odometry covariance", "simulated: counts"} <= {row["name"] for row in rows}
    assert not list(here.iterdir())
    biased = [np.abs(one[f"{case}: TDOA bias"]).max() for case in known]
    assert biased[0] == 0.0 and min(biased[1:]) > 0.1
