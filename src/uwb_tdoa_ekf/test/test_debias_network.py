"""The network of appendix A, beside a slow reading of its equations."""

from math import atan2, exp, log, pi

import numpy as np
import pytest

from uwb_tdoa_ekf.debias.network import AngularNetwork

STEP = 0.5


def nodes(n, d, values, wobble=0.0):
    """Cells, places and one column of values; values(at) -> (n,)."""
    cell = np.stack(np.meshgrid(*[np.arange(n)] * d, indexing="ij"), axis=-1).reshape(-1, d)
    at = STEP * cell + wobble * np.random.default_rng(2).standard_normal(cell.shape)
    return cell, at, values(at)[:, None]


def gentle(at):
    """Positive, and nowhere 8 times a neighbour's: eq. A5 has a positive width everywhere."""
    return 1.0 + 0.3 * np.sin(at[:, 0]) + 0.2 * np.cos(2.0 * at[:, 1])


def slow(cell, at, values, x):
    """Eqs. A1 - A8 one by one, in the plane, for one place."""
    b_min = min(values) if min(values) < 0 else 0.0
    b = values - b_min
    total, c1 = b_min, 0.5
    c3 = (1 - c1) / (8 * c1)
    for i in range(len(at)):
        d2 = float(np.sum((x - at[i]) ** 2))
        if d2 >= 1.0:
            continue
        widths = []
        for j in range(len(at)):
            if j != i and np.abs(cell[i] - cell[j]).max() == 1:
                away = at[j] - at[i]
                widths.append(
                    (atan2(away[1], away[0]), -log(c3 * b[j] / b[i]) / float(away @ away))
                )
        widths.sort()
        theta = atan2(x[1] - at[i][1], x[0] - at[i][0])
        widths = [
            (widths[-1][0] - 2 * pi, widths[-1][1]),
            *widths,
            (widths[0][0] + 2 * pi, widths[0][1]),
        ]
        c2 = np.interp(theta, *zip(*widths))
        total += c1 * b[i] * exp(-c2 * d2)
    return total


def test_equations_of_the_appendix():
    cell, at, values = nodes(4, 2, gentle, wobble=0.04)
    network = AngularNetwork(cell, at, values, STEP)
    places = np.random.default_rng(5).uniform(-0.5, 2.0, (60, 2))
    expected = [slow(cell, at, values[:, 0], x) for x in places]
    np.testing.assert_allclose(network(places)[:, 0], expected, atol=1e-9)


@pytest.mark.parametrize("d", [2, 3])
def test_an_inner_node_keeps_its_value(d):
    cell, at, values = nodes(5, d, gentle)
    network = AngularNetwork(cell, at, values, STEP)
    inner = ((cell > 0) & (cell < 4)).all(axis=1)
    shift = np.abs(network(at[inner]) - values[inner])
    assert shift.max() < 0.02  # tails of nodes two steps away


@pytest.mark.parametrize("d", [2, 3])
def test_negative_values_are_shifted_and_far_away_the_smallest_one_is_left(d):
    cell, at, values = nodes(4, d, lambda at: np.sin(3.0 * at[:, 0]) - 0.1)
    found = AngularNetwork(cell, at, values, STEP)(np.vstack([at, np.full((1, d), 50.0)]))
    assert np.isfinite(found).all()
    assert found[-1, 0] == pytest.approx(values.min())
    assert (found >= values.min() - 1e-12).all()


def test_a_width_that_would_be_negative_is_none_so_that_nothing_grows_with_distance():
    cell, at, values = nodes(3, 2, lambda at: np.where((at == 1.0).all(axis=1), 1.0, 0.01))
    found = AngularNetwork(cell, at, values, STEP)(
        np.random.default_rng(1).uniform(-1.0, 2.0, (500, 2))
    )
    assert found.max() < 0.7


def test_a_node_without_neighbours_and_columns_apart():
    cell, at = np.array([[0, 0], [5, 5]]), np.array([[0.0, 0.0], [2.5, 2.5]])
    values = np.array([[0.2, -0.3], [0.1, 0.4]])
    found = AngularNetwork(cell, at, values, STEP)(at)
    np.testing.assert_allclose(found, [[0.1, -0.3], [0.05, -0.3 + 0.5 * 0.7]])


def test_a_constant_below_zero_is_exact_everywhere():
    cell, at, values = nodes(3, 3, lambda at: np.full(len(at), -0.25))
    np.testing.assert_allclose(AngularNetwork(cell, at, values, STEP)(at + 0.13), -0.25)
