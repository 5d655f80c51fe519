import numpy as np

from uwb_tdoa_tools.training.linear import Design, fit, predict

SITES, FEATURES, DENSE = 4, 6, 3


def design(noise, outliers, seed=0, n=4000):
    """(Design, weights of the sites, dense weights).

    The sites' weights sum to zero: differences tell no common one.
    """
    random = np.random.default_rng(seed)
    weights, dense = random.normal(size=(SITES, FEATURES)), random.normal(size=DENSE)
    weights -= weights.mean(axis=0)
    a = random.integers(0, SITES, n)
    b = (a + random.integers(1, SITES, n)) % SITES
    phi, columns = random.normal(size=(n, FEATURES)), random.normal(size=(n, DENSE))
    made = Design(phi, a, b, columns, np.zeros(n), np.ones(n))
    y = predict(made, weights, dense) + noise * random.standard_normal(n)
    y[random.random(n) < outliers] += 5.0
    return Design(phi, a, b, columns, y, np.ones(n)), weights, dense


def test_finds_the_weights_despite_outliers():
    made, weights, dense = design(0.1, 0.1)
    found = fit(made, SITES, 0.1)
    np.testing.assert_allclose(found.site, weights, atol=0.02)
    np.testing.assert_allclose(found.dense, dense, atol=0.02)


def test_its_covariance_is_honest():
    errors, sizes = [], []
    for seed in range(40):
        made, _, dense = design(0.3, 0.0, seed, 300)
        found = fit(made, SITES, 0.3)
        errors.append(found.dense - dense)
        sizes.append(np.diag(found.dense_covariance))
    assert 0.5 < np.mean(np.square(errors) / sizes) < 1.5


def test_the_prior_is_as_large_as_the_weights():
    made, weights, dense = design(0.05, 0.0)
    found = fit(made, SITES, 0.05)
    assert 0.5 < found.site_std / weights.std() < 2.0 and 0.5 < found.dense_std / dense.std() < 2.0
