from covariances import assert_covariance, random_covariance
from finite_differences import numerical_jacobian
from hypothesis import given, strategies as st
import numpy as np
import pytest

from uwb_tdoa_bias.foundation.geometry import tdoa, tdoa_jacobian
from uwb_tdoa_ekf.core.robust import (
    CAUCHY, GEMAN_MCCLURE, HUBER, NEGLIGIBLE, gain_terms, predicted, update_gate, update_innovation,
    update_m_estimation, weight,
)  # fmt: skip
from uwb_tdoa_ekf.core.state import inject

seeds = st.integers(0, 2**32 - 1)
losses = st.sampled_from([GEMAN_MCCLURE, HUBER, CAUCHY])
HUGE = 1e9

# textbook losses (MacTavish and Barfoot 2015, table I), all e^2 / 2 near zero
RHO = {
    GEMAN_MCCLURE: lambda e, c: 0.5 * e**2 / (1.0 + (e / c) ** 2),
    HUBER: lambda e, c: 0.5 * e**2 if abs(e) <= c else c * (abs(e) - 0.5 * c),
    CAUCHY: lambda e, c: 0.5 * c**2 * np.log1p((e / c) ** 2),
}


class Case:
    """A random prior and one TDOA."""

    def __init__(self, seed, surprise=1.0):
        rng = np.random.default_rng(seed)
        self.x = np.zeros(16)
        self.x[:3], self.x[9] = rng.uniform(-5, 5, 3), 1.0
        self.P = random_covariance(rng)
        self.g, self.K = np.zeros(3), np.zeros(15)
        self.d = predicted(self.x, *rng.uniform(-5, 5, (2, 3)), self.g)
        self.spread = gain_terms(self.P, self.g, self.K)
        self.variance = 10.0 ** rng.uniform(-3, 1)
        self.dilution = rng.uniform(1.0, 8.0)
        self.innovation = surprise * rng.standard_normal() * np.sqrt(self.spread + self.variance)
        self.G = np.concatenate([self.g, np.zeros(12)])

    def arguments(self):
        return self.x, self.P, self.K, self.innovation, self.spread, self.variance, self.dilution

    def textbook(self, noise):
        """State and covariance after a Kalman update with this noise variance."""
        return self.updated(*kalman(self.P, self.G, self.innovation, noise))

    def updated(self, error, covariance):
        x = self.x.copy()
        inject(x, error, 1.0)
        return x, covariance

    def assert_is(self, x, P, rtol=1e-9):
        scale = np.sqrt(np.diag(P))
        np.testing.assert_allclose(self.P / np.outer(scale, scale), P / np.outer(scale, scale), atol=rtol)
        np.testing.assert_allclose(self.x, x, rtol=rtol, atol=rtol)


def kalman(P, G, innovation, noise):
    K = P @ G / (G @ P @ G + noise)
    return K * innovation, (np.eye(15) - np.outer(K, G)) @ P


def m_estimation(P, G, innovation, noise, loss, state_scale, scale, iterations):
    """Eqs. 8 - 13 of Zhao et al. (RA-L 2021) as they stand there, G at the prior mean, no weight of the measurement
    below 1e-6: error, covariance, weight."""
    S = np.linalg.cholesky(P)
    error = np.zeros(15)
    for _ in range(iterations):
        scaled = np.linalg.solve(S, error)  # eq. 9
        rescaled = S @ np.diag([1.0 / weight(loss, e, state_scale) for e in scaled]) @ S.T  # eq. 10
        w = max(weight(loss, (innovation - G @ error) / np.sqrt(noise), scale), 1e-6)
        error, posterior = kalman(rescaled, G, innovation, noise / w)  # eqs. 11, 13
    return error, posterior, w


@given(losses, st.floats(-30.0, 30.0), st.floats(0.5, 5.0))
def test_weight_is_the_slope_of_the_textbook_loss(loss, e, scale):
    if abs(e) < 0.01 or abs(abs(e) - scale) < 1e-3:  # the second is where Huber's slope has its corner
        return
    slope = (RHO[loss](e + 1e-5, scale) - RHO[loss](e - 1e-5, scale)) / 2e-5
    assert weight(loss, e, scale) == pytest.approx(slope / e, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("loss", RHO)
def test_weight_has_its_limits(loss):
    assert weight(loss, 0.0, 2.0) == 1.0
    assert weight(loss, 1e-9, 2.0) == pytest.approx(1.0)
    falling = [weight(loss, e, 2.0) for e in np.linspace(0.0, 50.0, 200)]
    assert all(0.0 <= later <= earlier <= 1.0 for earlier, later in zip(falling, falling[1:]))
    assert falling == [weight(loss, -e, 2.0) for e in np.linspace(0.0, 50.0, 200)]
    assert weight(loss, 1e6, 2.0) < 1e-5
    assert weight(loss, 1e300, 2.0) == 0.0
    # how fast an outlier is forgotten: with e^-4, e^-1, e^-2
    power = {GEMAN_MCCLURE: 4, HUBER: 1, CAUCHY: 2}[loss]
    assert weight(loss, 2e4, 2.0) / weight(loss, 2e5, 2.0) == pytest.approx(10.0**power, rel=1e-3)


@given(seeds)
def test_prediction_and_its_derivative(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(-5, 5, (2, 3))
    x, g = np.zeros(16), np.empty(3)
    x[:3] = rng.uniform(-5, 5, 3)
    assert predicted(x, a, b, g) == pytest.approx(tdoa(x[:3], a, b), abs=1e-12)
    closest = min(np.linalg.norm(x[:3] - a), np.linalg.norm(x[:3] - b))
    numerical = numerical_jacobian(lambda p: tdoa(p, a, b), x[:3], 1e-6 * closest)
    np.testing.assert_allclose(g, numerical[0], atol=1e-6)
    np.testing.assert_allclose(g, tdoa_jacobian(x[:3], a, b), atol=1e-12)


def test_prediction_on_an_antenna_is_finite():
    x, g = np.zeros(16), np.empty(3)
    assert predicted(x, np.zeros(3), np.array([3.0, 0.0, 0.0]), g) == pytest.approx(3.0, abs=1e-5)
    np.testing.assert_allclose(g, [-1.0, 0.0, 0.0])


@given(seeds)
def test_gain_terms(seed):
    case = Case(seed)
    np.testing.assert_allclose(case.K, case.P @ case.G, atol=1e-12 * np.abs(case.P).max())
    assert case.spread == pytest.approx(case.G @ case.P @ case.G, rel=1e-9)


@given(seeds)
def test_gate_that_is_open_gives_the_textbook_update(seed):
    case = Case(seed)
    expected = case.textbook(case.variance * case.dilution)
    assert update_gate(*case.arguments(), HUGE)[0] == 1.0
    case.assert_is(*expected)


@given(seeds)
def test_gate_judges_with_the_undiluted_variance_and_leaves_all_as_it_was(seed):
    case, gate = Case(seed, surprise=3.0), 2.0
    before = case.x.copy(), case.P.copy()
    passed = abs(case.innovation) <= gate * np.sqrt(case.spread + case.variance)
    assert update_gate(*case.arguments(), gate)[0] == passed
    if not passed:
        np.testing.assert_array_equal(case.x, before[0])
        np.testing.assert_array_equal(case.P, before[1])


@given(seeds, losses)
def test_innovation_with_a_huge_scale_gives_the_textbook_update(seed, loss):
    case = Case(seed)
    expected = case.textbook(case.variance * case.dilution)
    assert update_innovation(*case.arguments(), loss, HUGE)[0] == pytest.approx(1.0)
    case.assert_is(*expected)


@given(seeds, losses)
def test_innovation_divides_the_variance_by_the_weight_of_what_is_whitened(seed, loss):
    case = Case(seed, surprise=3.0)
    w = weight(loss, case.innovation / np.sqrt(case.spread + case.variance), 2.5)
    before = case.x.copy(), case.P.copy()
    expected = case.textbook(case.variance * case.dilution / w)
    found, _ = update_innovation(*case.arguments(), loss, 2.5)
    assert found == (w if w >= NEGLIGIBLE else 0.0)
    case.assert_is(*(expected if w >= NEGLIGIBLE else before))


@given(seeds, losses, st.integers(1, 5))
def test_m_estimation_with_huge_scales_gives_the_textbook_update(seed, loss, iterations):
    case = Case(seed)
    noise = case.variance * case.dilution
    expected = case.textbook(noise)
    w, _ = update_m_estimation(
        case.x, case.P, np.empty((15, 3)), case.K, case.g, case.innovation, case.variance, case.dilution,
        loss, HUGE, HUGE, iterations,
    )  # fmt: skip
    assert w == pytest.approx(1.0)
    case.assert_is(*expected)


@given(seeds, losses, st.integers(1, 6), st.floats(1.0, 4.0), st.floats(1.0, 4.0))
def test_m_estimation_is_that_of_the_paper(seed, loss, iterations, state_scale, scale):
    case = Case(seed, surprise=2.0)
    noise = case.variance * case.dilution
    error, covariance, expected = m_estimation(
        case.P, case.G, case.innovation, noise, loss, state_scale, scale, iterations
    )
    posterior = case.updated(error, covariance)
    w, _ = update_m_estimation(
        case.x, case.P, np.empty((15, 3)), case.K, case.g, case.innovation, case.variance, case.dilution,
        loss, state_scale, scale, iterations,
    )  # fmt: skip
    assert w == pytest.approx(expected, rel=1e-6)
    case.assert_is(*posterior, rtol=1e-6)


def test_m_estimation_follows_an_outlier_less_than_the_textbook():
    for loss in RHO:
        case = Case(7)
        case.innovation, case.variance, case.dilution = 5.0, 0.01, 1.0
        case.P[:] = np.diag([0.01] * 3 + [1.0] * 12)
        textbook, _ = case.textbook(0.01)
        before = case.x.copy()
        w, _ = update_m_estimation(
            case.x, case.P, np.empty((15, 3)), case.K, case.g, 5.0, 0.01, 1.0, loss, HUGE, 2.5, 2
        )  # fmt: skip
        assert 0.0 < w < 0.2
        assert np.linalg.norm(case.x - before) < 0.5 * np.linalg.norm(textbook - before)


@given(seeds, st.sampled_from(["gate", "innovation", "m_estimation"]), losses, st.floats(0.0, 5.0), st.integers(1, 5))
def test_every_update_leaves_a_covariance(seed, method, loss, surprise, iterations):
    case = Case(seed, surprise)
    before = case.P.copy()
    if method == "gate":
        update_gate(*case.arguments(), 3.0)
    elif method == "innovation":
        update_innovation(*case.arguments(), loss, 2.5)
    else:
        update_m_estimation(
            case.x, case.P, np.empty((15, 3)), case.K, case.g, case.innovation, case.variance, case.dilution,
            loss, 2.5, 2.5, iterations,
        )  # fmt: skip
    assert np.isfinite(case.x).all() and abs(np.linalg.norm(case.x[6:10]) - 1.0) < 1e-12
    assert_covariance(case.P)
    if method != "m_estimation":  # whose prior can lose weight
        assert (np.diag(case.P) <= np.diag(before) * (1.0 + 1e-12)).all()
