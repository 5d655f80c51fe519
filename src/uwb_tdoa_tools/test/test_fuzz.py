"""Every reader on changed files: it returns or raises InputError. `fuzz/run.py` does the same for as long as one likes."""

from pathlib import Path
import random
import signal
import subprocess
import sys

import pytest

FUZZ = Path(__file__).parent / "fuzz"
sys.path.append(str(FUZZ))
import mutations  # noqa: E402
import targets  # noqa: E402

SLOW = {"bag_mcap_salvaged": 8, "bag_sqlite": 15, "bag_sqlite_salvaged": 8, "bag_metadata": 10, "bag_message": 30, "bag_packed": 8}
EXAMPLES = 60


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


@pytest.mark.parametrize("name", targets.TARGETS)
def test_any_bytes_are_read_or_refused(name):
    chance = random.Random(0)
    for _ in range(SLOW.get(name, EXAMPLES)):
        targets.run(name, chance.randbytes(chance.randrange(200)))


def test_the_corpus_is_small():
    assert sum(path.stat().st_size for path in targets.CORPUS.rglob("*") if path.is_file()) < 200_000


@pytest.mark.parametrize(
    ("work", "code"), [("while True: pass", -signal.SIGPROF), ("bytearray(run.MEGABYTES + 50 << 20)", 1), ("bytearray(9 << 20)", 0)]
)
def test_who_fuzzes_ends_what_takes_too_long_or_too_much(work, code):
    program = (
        f"import sys; sys.path.insert(0, {str(FUZZ)!r}); import run, signal; run.watch(); signal.setitimer(signal.ITIMER_PROF, 0.2)\n{work}"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=FUZZ, capture_output=True, text=True)
    assert done.returncode == code and ("MemoryError" in done.stderr) == (code == 1)
