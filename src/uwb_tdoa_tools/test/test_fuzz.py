"""Every reader on changed files: it returns or raises InputError. `fuzz/run.py` does the same for as long as one likes."""

from pathlib import Path
import sys

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
import pytest

sys.path.append(str(Path(__file__).parent / "fuzz"))
import targets  # noqa: E402

SLOW = {"bag_mcap_salvaged": 8, "bag_sqlite": 15, "bag_sqlite_salvaged": 8, "bag_metadata": 10, "bag_message": 30}
EXAMPLES = 60
SETTINGS = settings(deadline=None, suppress_health_check=list(HealthCheck), derandomize=True, database=None)


@pytest.fixture(scope="module", autouse=True)
def no_scratch_is_left():
    yield
    targets.clean_up()


@st.composite
def changed(draw, name):
    """A file of the corpus with some bytes changed, left out, put in, or repeated."""
    data = bytearray(draw(st.sampled_from(targets.seeds(name))).read_bytes())
    for _ in range(draw(st.integers(1, 4))):
        at, what = draw(st.integers(0, len(data))), draw(st.sampled_from(("change", "cut", "insert", "repeat", "end")))
        size = draw(st.sampled_from((1, 2, 8, 64)))
        if what == "change":
            data[at : at + size] = draw(st.binary(min_size=1, max_size=8))
        elif what == "cut":
            del data[at : at + size]
        elif what == "insert":
            data[at:at] = draw(st.binary(min_size=1, max_size=8))
        elif what == "repeat":
            start = draw(st.integers(0, len(data)))
            data[at:at] = data[start : start + size]
        else:
            del data[at:]
    return bytes(data)


@pytest.mark.parametrize("name", targets.TARGETS)
def test_the_corpus_is_right(name):
    for path in targets.seeds(name):
        targets.TARGETS[name](path.read_bytes())  # no InputError either


@pytest.mark.filterwarnings("ignore:.*:RuntimeWarning")
@pytest.mark.parametrize("name", targets.TARGETS)
def test_a_changed_file_is_read_or_refused(name):
    @settings(SETTINGS, max_examples=SLOW.get(name, EXAMPLES))
    @given(changed(name))
    def read(data):
        targets.run(name, data)

    read()


@pytest.mark.parametrize("name", targets.TARGETS)
def test_any_bytes_are_read_or_refused(name):
    @settings(SETTINGS, max_examples=SLOW.get(name, EXAMPLES))
    @given(st.binary(max_size=200))
    def read(data):
        targets.run(name, data)

    read()


def test_the_corpus_is_small():
    assert sum(path.stat().st_size for path in targets.CORPUS.rglob("*") if path.is_file()) < 200_000
