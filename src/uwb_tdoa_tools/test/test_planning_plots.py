"""What the pictures of plan show: what a legend or a title names is there, colours say at which end
there is more, labels keep apart.
"""

from dataclasses import replace

import numpy as np
from PIL import Image
import pytest

from uwb_tdoa_tools.planning import plots
from uwb_tdoa_tools.planning.installation import Installation
from uwb_tdoa_tools.planning.layout import AnchorPlaces, Goal, lattice
from uwb_tdoa_tools.planning.maps import IMPRECISE, Demand, Grid, chart
from uwb_tdoa_tools.planning.optimisation import scores_of_one_more
from uwb_tdoa_tools.scoring.plots import draw_labels, plt
from uwb_tdoa_tools.simulation.rooms import corners

FLOWN = lattice((-1, -1, 0.5), (1, 1, 2), 1.0)


@pytest.fixture
def figures(monkeypatch):
    """[(figure, title)] of all pictures that would be written."""
    made = []
    monkeypatch.setattr(plots, "_save", lambda figure, title, path: made.append((figure, title)))
    return made


@pytest.fixture(scope="module")
def found():
    return chart(Installation(corners()), Grid.box((-3, -3, 0.5), (3, 3, 2.5), 0.5), Demand())


@pytest.mark.parametrize("flyable", [True, False])
def test_what_the_title_calls_hatched_is_hatched(found, flyable, figures):
    one = (
        replace(
            found, status=np.where(np.arange(len(found.status)) % 3 == 0, IMPRECISE, found.status)
        )
        if not flyable
        else found
    )
    plots.plot_layouts(
        [("before", Installation(corners()), one), ("after", Installation(corners()), one)],
        FLOWN,
        None,
    )
    (figure, title) = figures[0]
    hatched = figure.findobj(lambda artist: any(getattr(artist, "hatches", ())))
    assert bool(hatched) == ("hatched" in title) == (not flyable)


def test_a_scale_has_an_arrow_at_each_end_beyond_which_there_is_more(found, figures):
    plots.plot_precision(corners(), found, None)
    (figure, _) = figures[0]
    (bar,) = (ax._colorbar for ax in figure.axes if hasattr(ax, "_colorbar"))
    values = 100.0 * found.error
    assert (
        bar.extend
        == {
            (True, True): "both",
            (True, False): "min",
            (False, True): "max",
            (False, False): "neither",
        }[bool(values.min() < bar.vmin), bool(values.max() > bar.vmax)]
    )
    assert bar.get_ticks()[0] == pytest.approx(bar.vmin) and bar.get_ticks()[-1] == pytest.approx(
        bar.vmax
    )


def test_the_legend_states_the_share_of_each_state_that_there_is(found, figures):
    one = replace(found, status=np.where(np.arange(len(found.status)) % 4 == 0, IMPRECISE, 0))
    plots.plot_flyable(corners(), one, None)
    (_, title), texts = (
        figures[0],
        [text.get_text() for text in figures[0][0].legends[0].get_texts()],
    )
    assert (
        "can be flown: 75 %" in texts
        and "imprecise: 25 %" in texts
        and not any("two solutions" in text for text in texts)
    )
    assert "75 % of the room" in title


def test_anchors_a_little_beyond_a_map_are_inside_the_picture(figures):
    anchors, near = corners(), corners().positions[:, :2] + [0.2, -0.2]
    moved = anchors.at(np.column_stack([near, anchors.positions[:, 2]]))
    low, high = anchors.positions.min(axis=0), anchors.positions.max(axis=0)
    found = chart(Installation(anchors), Grid.box(low, high, 0.5), Demand())
    plots.plot_heard(moved, found, None)
    plots.plot_heard(anchors.at(moved.positions + [50.0, 0.0, 0.0]), found, None)
    (figure, _), (far, _) = figures
    ax, other = figure.axes[0], far.axes[0]
    for values, ends in zip(near.T, (ax.get_xlim(), ax.get_ylim())):
        assert ends[0] < values.min() and values.max() < ends[1]
    assert np.ptp(other.get_xlim()) < 1.3 * (high - low)[0]


def test_every_picture_is_700_pixels_wide(found, tmp_path):
    anchors, places = corners(), AnchorPlaces.walls((-3.5, -4, 0), (3.5, 4, 3))
    goal = Goal(FLOWN, Installation(anchors))
    plots.plot_precision(anchors, found, tmp_path / "precision.png")
    plots.plot_flyable(anchors, found, tmp_path / "flyable.png", pairings=Installation(anchors))
    plots.plot_heard(anchors, found, tmp_path / "heard.png")
    plots.plot_layouts(
        [("before", Installation(anchors), found)] * 2, FLOWN, tmp_path / "layout.png"
    )
    scored = scores_of_one_more(goal, anchors, places, 40)
    plots.plot_places(places, *scored, goal.objective, tmp_path / "places.png")
    for path in tmp_path.iterdir():
        assert Image.open(path).width == 700, path.name


def test_labels_cover_neither_each_other_nor_anchors():
    rng = np.random.default_rng(3)
    figure, ax = plt.subplots(figsize=(7, 5))
    ax.set(xlim=(0, 20), ylim=(0, 14))
    places = np.vstack([[0, 0], [20, 0], [20, 14], [0, 14], rng.uniform([1, 1], [19, 13], (16, 2))])
    figure.draw_without_rendering()
    draw_labels(ax, list(range(20)), places, np.empty((0, 2)))
    figure.canvas.draw()
    boxes = [text.get_window_extent() for text in ax.texts]
    covered = sum(one.overlaps(other) for i, one in enumerate(boxes) for other in boxes[:i])
    on_anchors = sum(box.contains(*dot) for box in boxes for dot in ax.transData.transform(places))
    plt.close(figure)
    assert len(boxes) >= 19 and covered == 0 and on_anchors == 0
