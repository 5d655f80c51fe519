import numpy as np
import pytest
from training_flights import flight, without_attitude

from uwb_tdoa_bias.effects import EFFECTS
from uwb_tdoa_tools.training import models, physics
from uwb_tdoa_tools.training.labels import labels
from uwb_tdoa_tools.training.structured import StructuredPriors

PLAIN = {"bias": False, "outlier_probability": 0.0, "yaw": "along_track"}
DELAY = EFFECTS["anchor_delay"]({"2": 0.3})
MOVED = EFFECTS["anchor_position"]({"5.x": 0.5})
PUSHED = EFFECTS["accel_bias"]({"x": 0.8})


def injected(flights, *effects):
    for effect in effects:
        flights = [effect.inject(one) for one in flights]
    return flights


@pytest.fixture(scope="module")
def one_place():
    return injected([flight(seed, **PLAIN) for seed in range(3)], DELAY, PUSHED)


def test_finds_what_is_wrong_with_anchors_and_imu(one_place):
    found = physics.find_effects(one_place)
    values = {effect.name: effect.values for effect in found.effects.effects}
    assert values["anchor_delay"]["2"] == pytest.approx(0.3, abs=0.03)
    assert values["accel_bias"]["x"] == pytest.approx(0.8, abs=0.1)
    for some in ([0], [0, 1]):
        fewer = {effect.name: effect.values for effect in found.fitted_to(some).effects}
        assert fewer["anchor_delay"]["2"] == pytest.approx(0.3, abs=0.05)
        assert fewer["anchor_delay"] != values["anchor_delay"]


def test_of_several_constellations_only_what_carries_over(one_place):
    elsewhere = [flight(seed, "pillars", **PLAIN) for seed in (3, 4)]
    flights = [*one_place[:2], *injected(elsewhere, DELAY, PUSHED)]
    flights = [*injected(flights[:2], MOVED), *flights[2:]]
    names = {effect.name for effect in physics.find_effects(flights).effects.effects}
    assert "anchor_delay" in names and names <= {
        *physics.PORTABLE,
        "noise_level",
        "noise_correlation",
    }


def test_does_without_attitude():
    flights = injected([without_attitude(flight(seed, **PLAIN)) for seed in range(2)], DELAY)
    (effect,) = (
        e for e in physics.find_effects(flights).effects.effects if e.name == "anchor_delay"
    )
    assert effect.values["2"] == pytest.approx(0.3, abs=0.03)


def test_network_learns_what_the_effects_leave(one_place):
    kinds = ("physics", "physics+structured")
    found = physics.find_effects(one_place)
    options = StructuredPriors(centres=40)
    alone, both = (
        models.train(
            models.Recipe(kind, 0, options), one_place[:2], one_place[2:], kind, found=found
        )
        for kind in kinds
    )
    assert alone.model is None and alone.onnx() is None and both.onnx() is not None
    assert alone.effects == both.effects == found.effects
    for trained in (alone, both):
        ((before, after),) = trained.errors.values()
        assert (
            before == pytest.approx(np.sqrt(np.mean(labels(one_place[2]).error ** 2)))
            and after < 0.75 * before
        )
    left = labels(one_place[2], found.effects)
    assert np.sqrt(np.mean(both.model.mean(left.samples) ** 2)) < 0.02  # nothing is left to learn
