"""Every reader on changed files: it returns or raises InputError.

`./dev study fuzz` does the same for as long as one likes.
"""

import random

from fuzz import mutations, targets
import pytest

SLOW = {
    "bag_mcap_salvaged": 8,
    "bag_sqlite": 15,
    "bag_sqlite_salvaged": 8,
    "bag_metadata": 10,
    "bag_message": 30,
    "bag_packed": 8,
}
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
    assert (
        sum(path.stat().st_size for path in targets.CORPUS.rglob("*") if path.is_file()) < 200_000
    )
