"""As much of a model as flights left out bear out."""

import pytest
from training_flights import flight

from uwb_tdoa_bias.effects import EFFECTS
from uwb_tdoa_tools.scoring.gains import SHARES, Shrinkage, best_share
from uwb_tdoa_tools.training import models, shrinking, structured

RECIPE = models.Recipe("structured", 0, structured.StructuredPriors(centres=10, link_centres=10))


def errors(*ratios):
    """As of Shrinkage: of flights with an error of 0.5 m, ratios at all SHARES."""
    return {
        str(k): {None: 0.5} | dict(zip(SHARES, (0.5 * ratio for ratio in some)))
        for k, some in enumerate(ratios)
    }


@pytest.mark.parametrize(
    "ratios, share",
    [
        ([(1.0, 0.8, 0.7, 0.6), (1.0, 0.8, 0.7, 0.6)], 1.0),  # all gain
        ([(1.0, 1.0, 1.1, 1.2), (1.0, 1.1, 1.1, 1.1)], 0.0),  # none gains
        # the mean alone would take all but the last bit
        ([(1.0, 0.8, 0.7, 0.6), (1.0, 0.96, 1.0, 1.15)], 0.5),
    ],
)
def test_takes_what_gains_without_harm(ratios, share):
    assert best_share(errors(*ratios)) == share


def test_effects_alone_are_taken_as_they_are():
    told = Shrinkage(best_share({"a": {None: 0.4, 1.0: 0.3}}), {"a": {None: 0.4, 1.0: 0.3}})
    assert (
        told.share == 1.0
        and "falls by 25 % +- 0 % (of 1 flights, each left out; on the worst it falls by 25 %)"
        in told.as_text()
    )


def test_a_flight_is_judged_by_what_it_took_no_part_in():
    late = EFFECTS["anchor_delay"]({"3": 0.4, "5": -0.4})
    flights = [late.inject(flight(seed)) for seed in range(2)] + [flight(2)]
    told = shrinking.cross_validated(RECIPE, flights, shrinking.uncorrected(flights))
    assert set(told.errors) == {one.name for one in flights}
    alike, other = (told.errors[flights[k].name] for k in (0, 2))
    assert alike[1.0] < 0.95 * alike[None] and other[1.0] > 1.05 * other[None]
    assert told.share < 1.0 and told.as_dict()["worst"] == told.gains.min()
