"""What became of the measurements, second by second, by a clock that the test has."""

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from uwb_tdoa_ekf.monitoring.use import Use
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.results import VERDICTS

LOOK = 0.2  # s


class Looked:
    """A Use that is looked at five times a second."""

    def __init__(self):
        self.use, self.now, self.received, self.counts = Use(0.25), 50.0, Counter(), Counter()

    def go(self, seconds, running=True, rate=400, imu=1000, **shares):
        """Go on for seconds in which so many TDOAs came, with these shares of what became of them.

        Returns [(s, trouble)].
        """
        said = []
        for k in range(round(seconds / LOOK)):
            self.now += LOOK
            self.received["tdoa"] += round(LOOK * rate)
            self.counts["imu_used"] += round(LOOK * imu)
            for name, share in shares.items():
                self.counts[name] += round(LOOK * rate * share)
            self.use.look(self.now, self.received, self.counts, running)
            said.append(((k + 1) * LOOK, self.use.trouble))
        return said

    def first(self, seconds, **shares):
        """Seconds until something is said, and what."""
        return next(
            ((at, words) for at, words in self.go(seconds, **shares) if words), (float("inf"), "")
        )


@pytest.mark.parametrize(
    ("reason", "words"),
    [("late", "-p lag"), ("invalid", "of ids that"), ("rejected", "contradict")],
)
def test_tdoas_of_which_none_is_used_are_named_within_two_seconds(reason, words):
    looked = Looked()
    assert not any(said for _, said in looked.go(10.0, used=1.0))
    at, said = looked.first(3.0, **{reason: 1.0})
    assert at <= 2.0 and words in said
    assert looked.use.tdoa_age >= 0.9 and looked.use.arrival_age < 0.3
    assert looked.go(4.5, used=1.0)[-1][1] is None


def test_a_start_and_a_landing_do_not_contradict():
    """Of measured flights on the floor: 85 % rejected for 3 s after the start and for 2 s after
    landing.
    """
    looked = Looked()
    assert not any(said for _, said in looked.go(3.0, rejected=0.85, used=0.15))
    assert not any(said for _, said in looked.go(20.0, rejected=0.03, used=0.97))
    assert not any(said for _, said in looked.go(2.0, rejected=0.85, used=0.15))


def test_most_that_contradict_for_long_are_named():
    looked = Looked()
    looked.go(10.0, used=1.0)
    at, said = looked.first(6.0, rejected=0.7, used=0.3)
    assert at <= 4.0 and "contradict" in said and looked.use.contradicted


def test_silence_and_restarts_have_an_age():
    looked = Looked()
    assert looked.use.tdoa_age == looked.use.imu_age == float("inf")
    looked.go(2.0, used=1.0)
    looked.go(3.0, rate=0, imu=0)
    assert (
        looked.use.tdoa_age == pytest.approx(3.0) == looked.use.imu_age
        and not looked.use.imu_used
        and looked.use.trouble is None
    )
    looked.counts["restarts"] += 1
    looked.go(1.0, rejected=1.0)
    assert looked.use.restart_age == pytest.approx(0.8)


def test_nothing_is_said_of_measured_flights(shared_data):
    """From their start on the floor to their landing, whenever it is looked."""
    flights = pytest.importorskip("test_stream_watch").flights
    for name, flight in flights(shared_data):
        run = run_offline(flight)
        t, verdict = run.residuals.t, run.residuals.verdict
        for phase in (0.0, 0.07, 0.13):
            use = Use(0.25)
            for now in np.arange(t[0] + phase, t[-1], LOOK):
                so_far = verdict[: np.searchsorted(t, now)]
                counts = Counter(
                    {word: int(np.sum(so_far == value)) for value, word in VERDICTS.items()}
                )
                use.look(now, Counter(tdoa=len(so_far)), counts, bool(now > run.odometry.t[0]))
                assert use.trouble is None, (name, now - t[0], use.trouble)


@given(st.lists(st.tuples(*[st.integers(0, 50)] * 4), min_size=20, max_size=60))
def test_shares_are_shares_whatever_comes(steps):
    use, counts, received, now = Use(0.25), Counter(), Counter(), 0.0
    for step in steps:
        now += LOOK
        counts.update(dict(zip(("used", "late", "invalid", "rejected"), step)))
        received["tdoa"] += sum(step)
        use.look(now, received, counts, True)
        shares = use._shares(1.5)
        assert all(0.0 <= share <= 1.0 for share in shares.values()) and (
            not shares or sum(shares.values()) == pytest.approx(1.0)
        )
