"""Who fuzzes notices what is no InputError, takes too long or takes too much, and goes on behind
it.
"""

from mmap import mmap

from fuzz import targets
import pytest

from studies import fuzz
from studies.__main__ import main
from uwb_tdoa_bias.common.errors import InputError

SEED = b"seed"


def hangs(data):
    while True:
        pass


def grows(data):
    bytearray(fuzz.MEGABYTES + 50 << 20)


def holds(data):
    with mmap(-1, 20 << 20) as memory:  # memory that this process had not before
        memory.write(b"x" * (20 << 20))


def refuses(data):
    raise InputError("no")


def fails(data):
    raise ValueError("a defect")


@pytest.fixture(autouse=True)
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
def test_what_is_found(monkeypatch, tmp_path, capsys, work, said):
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


def test_a_file_is_made_again_by_its_number():
    assert [fuzz.changed("yaml", 1, number) for number in range(5)] == [
        fuzz.changed("yaml", 1, number) for number in range(5)
    ]
