import numpy as np
import pytest

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_ekf.debias import LayerConfig, Layers


def run(config, p, v=None, dt=0.01):
    layers = Layers(config)
    v = np.gradient(p, dt, axis=0) if v is None else v
    return np.array([layers.filter(k * dt, *row) for k, row in enumerate(zip(p, v))])


def path(n=200, dt=0.01):
    t = dt * np.arange(n)
    return np.column_stack([np.sin(t), 0.5 * t, 1.0 + 0.1 * np.cos(2.0 * t)])


def test_all_are_off_by_default():
    assert Layers(LayerConfig()).idle
    np.testing.assert_array_equal(run(LayerConfig(), path()), path())
    for on in ({"saturate": True}, {"smooth": 0.5}, {"adams_moulton": True}):
        assert not Layers(LayerConfig(**on)).idle


def test_saturation_limits_the_step_of_the_position_and_then_catches_up():
    p = np.zeros((30, 3))
    p[10:, 0] = 0.2  # jumps by 20 cm in 10 ms
    found = run(LayerConfig(saturate=True, max_speed=(2.0, 2.0, 2.0)), p, np.zeros_like(p))
    steps = np.linalg.norm(np.diff(found, axis=0), axis=1)
    assert steps.max() == pytest.approx(0.02) and np.count_nonzero(steps) == 10
    np.testing.assert_allclose(found[-1], p[-1], atol=1e-9)


def test_saturation_leaves_what_is_possible():
    np.testing.assert_allclose(run(LayerConfig(saturate=True), path()), path(), atol=1e-12)


def test_saturation_limits_the_velocity_either_way():
    """Seen through what the velocities predict."""
    p, v = np.zeros((60, 3)), np.zeros((60, 3))
    v[5:] = (50.0, -50.0, 0.0)
    config = LayerConfig(
        saturate=True,
        max_speed=(2.0, 2.0, 2.0),
        max_acceleration=1000.0,
        adams_moulton=True,
        least_weight=0.0,
    )
    found = run(config, p, v)
    np.testing.assert_allclose(
        found[-1], [0.02, -0.02, 0.0], atol=0.005
    )  # exp(-2) of the estimate is left


def test_smoothing_is_the_weighted_mean_of_eq_a26():
    p = np.random.default_rng(1).standard_normal((6, 3))
    found = run(LayerConfig(smooth=0.4, history=3), p)
    weights = [0.4, 0.4 * 0.6, 0.4 * 0.6**2, 0.6**3]
    np.testing.assert_allclose(found[5], sum(w * p[5 - k] for k, w in enumerate(weights)))
    np.testing.assert_allclose(found[0], p[0])
    assert sum(weights) == pytest.approx(1.0)


def test_adams_moulton_predicts_a_smooth_motion_to_its_order():
    t = 0.1 * np.arange(12)
    p = np.column_stack([t**4, t**2 - t, 1.0 + 0.0 * t])
    v = np.column_stack([4.0 * t**3, 2.0 * t - 1.0, 0.0 * t])
    config = LayerConfig(adams_moulton=True, flipping_speed=(1e-6,) * 3, least_weight=0.0)
    found = run(config, p, v, dt=0.1)
    np.testing.assert_allclose(found[4:], p[4:], atol=1e-12)  # exact for polynomials of degree 5


def test_at_low_speed_the_estimate_counts_and_at_high_speed_the_prediction():
    p = np.zeros((20, 3))
    p[19] = 0.1  # the estimate jumps where the velocities say nothing of it
    for speed, share in ((0.0, 1.0), (100.0, 0.3)):
        v = np.full((20, 3), speed)
        still = run(LayerConfig(adams_moulton=True, least_weight=0.3), np.zeros((20, 3)), v)
        moved = run(LayerConfig(adams_moulton=True, least_weight=0.3), p, v)
        np.testing.assert_allclose((moved - still)[19], 0.1 * share, atol=1e-9)


def test_reset_forgets():
    layers = Layers(LayerConfig(smooth=0.1, saturate=True))
    layers.filter(0.0, np.zeros(3), np.zeros(3))
    layers.reset()
    np.testing.assert_array_equal(layers.filter(5.0, np.ones(3), np.zeros(3)), np.ones(3))


@pytest.mark.parametrize(
    "bad",
    [
        {"max_speed": (1.0, 1.0)},
        {"max_speed": (1.0, 0.0, 1.0)},
        {"flipping_speed": (1.0, float("nan"), 1.0)},
        {"max_acceleration": 0.0},
        {"smooth": 0.0},
        {"smooth": 1.5},
        {"least_weight": -0.1},
        {"history": 0},
    ],
)
def test_bad_values_are_refused_by_name(bad):
    with pytest.raises(InputError, match=f"^{next(iter(bad))}: "):
        LayerConfig(**bad)
