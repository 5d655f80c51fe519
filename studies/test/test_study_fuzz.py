# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""On changed files, every reader returns or raises InputError."""

import contextlib
import random

import pytest

from studies import fuzz
from studies.__main__ import main
from uwb_tdoa_bias.common.errors import InputError

FILES = {"bag_sqlite": 15, "bag_metadata": 10, "model": 3}  # of slow kinds


def hangs(path):
    while True:
        pass


def grows(path):
    bytearray(fuzz.MEGABYTES + 2000 << 20)  # more than a worker of tests may have free


def fails(path):
    raise ValueError("a defect")


def refuses(path):
    raise InputError("no")


@pytest.mark.parametrize(
    ("reader", "said"),
    [
        (hangs, "ended by SIGPROF"),
        (grows, "MemoryError in grows"),
        (fails, "ValueError in fails"),
        (refuses, None),
    ],
)
def test_what_is_found_is_kept_and_made_again_by_its_number(
    monkeypatch, tmp_path, capsys, reader, said
):
    monkeypatch.setattr(fuzz, "SECONDS", 0.1 if reader is hangs else fuzz.SECONDS)
    corpus = [path.read_bytes() for path in fuzz.seeds("yaml")]
    whole = lambda path: None if path.read_bytes() in corpus else reader(path)  # noqa: E731
    monkeypatch.setitem(fuzz.TARGETS, "yaml", whole)
    out = tmp_path / "out"
    assert main(["fuzz", "yaml", "--count", "3", "--out", str(out)]) == (said is not None)
    if said is None:
        assert not out.exists()
    else:
        assert f"yaml-0-0: {said}" in capsys.readouterr().out
        assert (out / "yaml-0-0").read_bytes() == fuzz.changed("yaml", 0, 0)


@pytest.mark.filterwarnings("ignore:.*:RuntimeWarning")
@pytest.mark.parametrize("kind", fuzz.TARGETS)
def test_the_corpus_is_read_and_changed_files_are_read_or_refused(kind):
    for path in fuzz.seeds(kind):
        fuzz.read(kind, path.read_bytes())  # no InputError
    for number in range(FILES.get(kind, 60)):
        with contextlib.suppress(InputError):
            fuzz.read(kind, fuzz.changed(kind, 0, number))
    with contextlib.suppress(InputError):
        fuzz.read(kind, random.Random(0).randbytes(200))
