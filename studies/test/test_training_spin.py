# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The study of a vehicle that spins."""

import numpy as np

from studies import __main__ as study
from studies.training import spin


def test_orientation_matters_and_the_specimen_hardly(tmp_path, capsys):
    assert study.main(["spin", "--out", str(tmp_path / "spin.png")]) == 0
    assert (tmp_path / "spin.png").stat().st_size > 10_000
    lines = capsys.readouterr().out.splitlines()[:2]
    turned, specimens = (float(line.split("between them")[1].split()[0]) for line in lines)
    assert turned > 2.0 * specimens > 0.0


def test_the_error_comes_again_with_every_turn():
    (yaw, one), (_, other) = (spin.over_yaw(0.0, 0, seed) for seed in (0, 1))
    assert len(yaw) == 36 and np.isfinite(one).all()
    assert np.std(one - other) < 0.3 * np.std(one)
