# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""On changed files, every reader returns or raises InputError.

The fuzzing study reports other exceptions, and files that take too long or too much memory. It then
continues with the next file.
"""

from mmap import mmap
import random

import pytest

from studies.__main__ import main
from studies.fuzzing import figures as fuzz, mutations, targets
from uwb_tdoa_bias.common.errors import InputError

SLOW = {
    "bag_mcap_salvaged": 8,
    "bag_sqlite": 15,
    "bag_sqlite_salvaged": 8,
    "bag_metadata": 10,
    "bag_message": 30,
    "bag_packed": 8,
}
EXAMPLES = 60
SEED = b"seed"


def hangs(data):
    while True:
        pass


def grows(data):
    bytearray(fuzz.MEGABYTES + 2000 << 20)  # more than a worker of tests may have free


def holds(data):
    with mmap(-1, 20 << 20) as memory:  # memory that this process had not before
        memory.write(b"x" * (20 << 20))


def refuses(data):
    raise InputError("no")


def fails(data):
    raise ValueError("a defect")


@pytest.fixture
def one_seed(tmp_path, monkeypatch):
    (tmp_path / "seed").write_bytes(SEED)
    monkeypatch.setattr(targets, "seeds", lambda kind: [tmp_path / "seed"])


@pytest.mark.parametrize(
    ("work", "said"),
    [
        (hangs, "ended by SIGPROF"),
        (grows, "MemoryError in grows"),
        (fails, "ValueError in fails"),
        (holds, None),
        (refuses, None),
    ],
)
def test_what_is_found(one_seed, monkeypatch, tmp_path, capsys, work, said):
    if work is hangs:
        monkeypatch.setattr(fuzz, "SECONDS", 0.1)
    monkeypatch.setitem(targets.TARGETS, "yaml", lambda data: None if data == SEED else work(data))
    outcomes, slowest, largest, findings = fuzz.fuzz("yaml", 0, 0, 3)
    assert outcomes.total() == 3 and slowest < 1.0
    assert (largest > 19.0) == (work is holds)
    assert main(["fuzz", "yaml", "--count", "3", "--out", str(tmp_path / "out")]) == (
        said is not None
    )
    if said is None:
        assert not findings and not (tmp_path / "out").exists()
    else:
        assert said in findings[0] and f"yaml-0-0: {said}" in capsys.readouterr().out
        assert (tmp_path / "out" / "yaml-0-0").read_bytes() == fuzz.changed("yaml", 0, 0) != SEED


def test_a_file_is_made_again_by_its_number(one_seed):
    assert [fuzz.changed("yaml", 1, number) for number in range(5)] == [
        fuzz.changed("yaml", 1, number) for number in range(5)
    ]


@pytest.fixture(scope="module", autouse=True)
def no_scratch_is_left():
    yield
    targets.clean_up()


@pytest.mark.parametrize("name", targets.TARGETS)
def test_the_corpus_is_right(name):
    for path in targets.seeds(name):
        targets.TARGETS[name](path.read_bytes())  # no InputError either


@pytest.mark.filterwarnings("ignore:.*:RuntimeWarning")
@pytest.mark.parametrize("name", targets.TARGETS)
def test_a_changed_file_is_read_or_refused(name):
    chance, seeds = random.Random(0), [path.read_bytes() for path in targets.seeds(name)]
    for _ in range(SLOW.get(name, EXAMPLES)):
        targets.run(name, mutations.changed(name, chance.choice(seeds), chance))


@pytest.mark.slow
@pytest.mark.parametrize("name", targets.TARGETS)
def test_any_bytes_are_read_or_refused(name):
    chance = random.Random(0)
    for _ in range(SLOW.get(name, EXAMPLES)):
        targets.run(name, chance.randbytes(chance.randrange(200)))
