import numpy as np
import pytest

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_ekf.debias import INTERPOLATORS, Part, fit


def field(true):
    """A bias of up to 0.2 m, (n, 3)."""
    return 0.15 * np.stack(
        [np.sin(true[:, 0]), np.cos(true[:, 1]), np.sin(0.7 * true[:, 0] + true[:, 2])], axis=1
    )


def fly(seed, n=4000, noise=0.03, claimed=None, bias=field):
    """A Part all over 3 x 3 x 2 m. claimed : standard deviation that its covariance says, m; None
    for no covariance.
    """
    rng = np.random.default_rng(seed)
    true = rng.uniform([0.0, 0.0, 0.0], [3.0, 3.0, 2.0], (n, 3))
    measured = true + bias(true) + noise * rng.standard_normal((n, 3))
    return Part(
        measured, true, None if claimed is None else np.tile(claimed**2 * np.eye(3), (n, 1, 1))
    )


def left_over(bias_map, part):
    known = bias_map.validity(part.measured) == 1.0
    return (part.measured - bias_map.bias_at(part.measured) - part.true)[known]


@pytest.mark.parametrize("planar", [False, True])
def test_a_known_bias_is_found_and_taken_out_elsewhere(planar):
    found = fit([fly(1), fly(2)], 0.5, least=10, planar=planar)
    fresh = fly(3, noise=0.0)
    before, after = field(fresh.true), left_over(found, fresh)
    d = 2 if planar else 3
    assert np.std(before[:, :d]) > 0.08
    assert np.sqrt(np.mean(after[:, :d] ** 2)) < 0.02
    assert found.planar == planar


def test_the_network_needs_a_full_grid_and_is_worse_than_the_thin_plate():
    """In the plane, markers everywhere: both help."""
    parts, fresh = [fly(1, 8000), fly(2, 8000)], fly(3, noise=0.0)
    left = {
        kind: left_over(fit(parts, 0.5, 10, True, kind), fresh)[:, :2] for kind in INTERPOLATORS
    }
    rms = {kind: np.sqrt(np.mean(error**2)) for kind, error in left.items()}
    assert (
        rms["thin_plate"] < rms["network"] < 0.6 * np.sqrt(np.mean(field(fresh.true)[:, :2] ** 2))
    )


@pytest.mark.parametrize(("claimed", "honest"), [(0.03, True), (0.2, False)])
def test_covariances_become_honest_but_never_smaller(claimed, honest):
    def drifting(seed):  # a bias of the flight's own, which no map can know
        own = 0.08 * np.random.default_rng(seed).standard_normal(3)
        return fly(seed, 1500, claimed=claimed, bias=lambda true: field(true) + own)

    found = fit([drifting(seed) for seed in range(10)], 0.5, least=10)
    fresh = [drifting(seed) for seed in range(20, 40)]
    nees = []
    for part in fresh:
        p, covariance, validity = found.correct(part.measured, part.covariance)
        error = (p - part.true)[validity == 1.0]
        nees.append(
            np.mean(
                np.einsum(
                    "ni,ni->n",
                    error,
                    np.linalg.solve(covariance[validity == 1.0], error[:, :, None])[:, :, 0],
                )
            )
        )
    if honest:
        assert 2.0 < np.mean(nees) < 5.0  # 20 flights: a third of 3 either way, and more above
        assert np.trace(found.added) > 0.01
    else:
        assert np.mean(nees) < 3.0 and not found.added.any()


def test_points_without_covariance_add_the_map_s_whole_error():
    places = np.stack(np.meshgrid(*[np.arange(0.0, 3.1, 0.5)] * 2, indexing="ij"), axis=-1).reshape(
        -1, 2
    )
    true = np.column_stack([places, np.zeros(len(places))])
    parts = [Part(row + field(row[None]), row[None]) for row in true]
    found = fit(parts, 0.5, planar=True)
    assert len(found.at) == len(places)
    assert 0.0 < np.sqrt(found.added[0, 0]) < 0.05


def test_one_flight_alone_is_cut_into_stretches():
    assert np.isfinite(fit([fly(1)], 0.5, least=10).added).all()


@pytest.mark.parametrize(
    ("parts", "named"),
    [
        ([], "none is within 1 m of the truth"),
        ([Part(np.full((5, 3), 9.0), np.zeros((5, 3)))], "none is within 1 m"),
        ([Part(np.full((5, 3), np.nan), np.zeros((5, 3)))], "none is within 1 m"),
        ([fly(1, n=20)], "no cell of 0.5 m holds 10 positions"),
    ],
)
def test_too_little_is_refused(parts, named):
    with pytest.raises(InputError, match=named):
        fit(parts, 0.5, least=10)
