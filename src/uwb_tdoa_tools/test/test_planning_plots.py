"""What the pictures of plan show: scales that somebody can read, and hatching where the title says so."""

from dataclasses import replace

import numpy as np
import pytest
from uwb_tdoa_tools.planning import plots
from uwb_tdoa_tools.planning.installation import Installation
from uwb_tdoa_tools.planning.maps import Grid, chart
from uwb_tdoa_tools.simulation.constellations import corners


@pytest.fixture
def figures(monkeypatch):
    """[(figure, title)] of all pictures that would be written."""
    made = []
    monkeypatch.setattr(plots, "_save", lambda figure, title, path: made.append((figure, title)))
    return made


@pytest.fixture(scope="module")
def found():
    return chart(Installation(corners()), Grid.box((-3, -3, 0.5), (3, 3, 2.5), 0.5))


def test_where_nothing_is_ambiguous_the_scale_does_not_show_rounding_errors(found, figures):
    none = replace(found, ambiguous=np.zeros(len(found.hull)), hull=np.ones(len(found.hull), bool))
    plots.plot_failure(Installation(corners()), none, None)
    (figure, _), shares = figures[0], []
    for ax in figure.axes:
        shares += [mesh.get_clim() for mesh in ax.collections if mesh.colorbar is not None and ax.get_title()]
    assert shares and all(low == 0.0 and high >= 10.0 for low, high in shares)


@pytest.mark.parametrize("flyable", [True, False])
def test_what_the_title_calls_hatched_is_hatched(found, flyable, figures):
    some = np.ones(len(found.hull), bool)
    some[: len(some) // 3] = flyable
    one = replace(found, flyable=some)
    plots.plot_layouts([("before, ", Installation(corners()), one), ("after, ", Installation(corners()), one)], None)
    (figure, title) = figures[0]
    hatched = figure.findobj(lambda artist: any(getattr(artist, "hatches", ())))
    assert bool(hatched) == ("hatched" in title) == (not flyable)
