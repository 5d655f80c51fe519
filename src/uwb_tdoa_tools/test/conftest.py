# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Settings for the tests of this package."""

import fcntl
import os
from pathlib import Path
import pickle
import sys

from hypothesis import settings
import pytest

# test helpers of the packages below
for package in ("uwb_tdoa_bias", "uwb_tdoa_ekf"):
    sys.path.append(str(Path(__file__).resolve().parents[2] / package / "test"))

# A busy machine is no error: the first call of a compiled function takes seconds.
# Every run tries the same examples.
settings.register_profile("compiled", deadline=None, derandomize=True)
settings.load_profile("compiled")


def _made_once(tmp_path_factory, name, make):
    """Return make(). The first process of this test run computes it, the others read its file."""
    folder = tmp_path_factory.getbasetemp()
    folder = folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder
    file = folder / f"{name}.pickle"
    with open(folder / f"{name}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not file.exists():
            file.write_bytes(pickle.dumps(make()))
    return pickle.loads(file.read_bytes())


@pytest.fixture(scope="session")
def diagnosed(tmp_path_factory):
    """Return the Diagnosis of a flight with a late and a displaced anchor, and a hold-out flight."""
    import known_effects

    return _made_once(tmp_path_factory, "diagnosed", known_effects.diagnosed)


@pytest.fixture(scope="session")
def diagnosed_without_truth(tmp_path_factory):
    """Return the Diagnosis of a flight with a late anchor, without ground truth."""
    import known_effects

    return _made_once(
        tmp_path_factory, "diagnosed_without_truth", known_effects.diagnosed_without_truth
    )
