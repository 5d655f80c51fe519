# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Sparse tables give the same results as dense tables.

Elimination of unknowns, and the effect of changes, agree with the full system.
"""

from dataclasses import replace

from known_effects import clean_flight, effect_of
import numpy as np
import pytest
from test_diagnosis_regression import named, table_with

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.effects import EFFECTS
from uwb_tdoa_ekf.evidence import MOVED, POSITION, Part, eliminated, with_each_change
from uwb_tdoa_tools.diagnosis import deviations
from uwb_tdoa_tools.diagnosis.regression.confounding import alternatives, unobservable
from uwb_tdoa_tools.diagnosis.regression.fit import fit
from uwb_tdoa_tools.diagnosis.regression.held_out import held_out
from uwb_tdoa_tools.diagnosis.regression.select import rank, select
from uwb_tdoa_tools.diagnosis.regression.terms import columns_of
from uwb_tdoa_tools.diagnosis.self_calibration.prior import Prior, posterior, solve


@pytest.fixture(scope="module")
def both():
    """Return (dense Table, the same as a sparse Table, [Candidate])."""
    table, candidates = table_with(
        effect_of("anchor_delay", True, 1).inject(clean_flight(100, 30.0))
    )
    bare = replace(table, columns={}, sparse=True)
    return (
        table,
        bare.with_terms([term for candidate in candidates for term in candidate.terms]),
        candidates,
    )


def test_a_sparse_table_holds_the_same_columns(both):
    dense, sparse, _ = both
    np.testing.assert_array_equal(
        sparse.matrix(dense.columns).toarray(), dense.matrix(dense.columns)
    )
    some = dense.t > 10.0
    one, other = dense.rows(some), sparse.rows(some)
    np.testing.assert_array_equal(other.matrix(one.columns).toarray(), one.matrix(one.columns))
    np.testing.assert_array_equal(one.matrix(one.columns), dense.matrix(dense.columns)[some])
    rows = dense.rows_of("gyro")
    np.testing.assert_array_equal(
        sparse.matrix(dense.columns, rows).toarray(), dense.matrix(dense.columns, rows)
    )


def test_fits_and_selections_of_a_sparse_table_are_those_of_a_dense_one(both):
    dense, sparse, candidates = both
    one, other = (fit(table, columns_of(candidates)) for table in (dense, sparse))
    for name in ("beta", "cov", "residual", "weight", "scale", "inflation"):
        np.testing.assert_allclose(getattr(other, name), getattr(one, name), rtol=1e-6, atol=1e-9)
    ranked = [
        rank(table, candidates, [named(candidates, "anchor_delay")], one)
        for table in (dense, sparse)
    ]
    assert [item[1].label for item in ranked[0]] == [item[1].label for item in ranked[1]]
    np.testing.assert_allclose(
        *([item[0] for item in some] for some in ranked), rtol=1e-6, atol=1e-6
    )
    found = [select(table, candidates, one.inflation) for table in (dense, sparse)]
    assert [[c.label for c in each.chosen] for each in found] == [
        [named(candidates, "anchor_delay", found[0].chosen[0].terms[0].keys).label]
    ] * 2
    for judge in (
        held_out,
        lambda each: alternatives(each, each.chosen[0], candidates),
        lambda each: unobservable(each, candidates),
    ):
        assert len(judge(found[0])) == len(judge(found[1]))
    np.testing.assert_allclose(held_out(found[1])[0].gain, held_out(found[0])[0].gain, rtol=1e-6)
    stds = [np.diag(deviations.with_deviations(each).fit.cov) for each in found]
    np.testing.assert_allclose(*stds, rtol=1e-6)


def equations(n_anchors, functions=6, seed=0):
    """Return normal equations (gram, vector).

    The unknowns are 4 for each of n_anchors anchors, and one for each function. The last two
    functions occur in no row.
    """
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((300, 4 * n_anchors + functions))
    x[:, -2:] = 0.0
    return 100.0 * x.T @ x, 100.0 * x.T @ (x[:, :1] * 0.3 + 0.1 * rng.standard_normal((300, 1)))[
        :, 0
    ]


def test_what_is_eliminated_is_integrated_out():
    gram, vector = equations(3)
    less, right, evidence = eliminated(gram, vector, 12, 0.2)
    rest = gram[12:, 12:] + np.eye(6) / 0.04
    np.testing.assert_allclose(
        less,
        gram[:12, :12] - gram[:12, 12:] @ np.linalg.solve(rest, gram[12:, :12]),
        rtol=1e-9,
        atol=1e-6,
    )
    np.testing.assert_allclose(
        right,
        vector[:12] - gram[:12, 12:] @ np.linalg.solve(rest, vector[12:]),
        rtol=1e-9,
        atol=1e-6,
    )
    expected = vector[12:] @ np.linalg.solve(rest, vector[12:]) - np.linalg.slogdet(0.04 * rest)[1]
    assert evidence == pytest.approx(0.5 * expected)


def test_what_a_change_would_bring_is_what_a_prior_with_it_says():
    gram, vector = equations(3)
    part, rng = Part(*eliminated(gram, vector, 12, 0.2), 0.2), np.random.default_rng(2)
    root = 0.02 * rng.standard_normal((12, 12))
    covariance, offset = root @ root.T + 1e-4 * np.eye(12), 0.01 * rng.standard_normal(12)
    places = np.array([3, 4, 5])
    found = with_each_change([part], covariance, offset, {"moved": (places, MOVED)})["moved"]
    wider = covariance.copy()
    wider[places, places] += MOVED**2
    assert found == pytest.approx(posterior(part, wider, offset).evidence)


def test_among_many_anchors_one_that_is_not_where_the_tape_says_is_named():
    n, rng = 70, np.random.default_rng(1)
    truth = np.zeros(4 * n)
    truth[30:33] = 0.4, -0.4, 0.2
    truth[3 * n + 50] = 0.3
    x = rng.standard_normal((3000, 4 * n)) * (rng.random((3000, 4 * n)) < 0.1)
    y = x @ truth + 0.02 * rng.standard_normal(3000)
    prior = Prior.of(Anchors.from_positions(rng.uniform(0.0, 100.0, (n, 3))), np.full((n, 3), 0.05))
    found = solve(x.T @ x / 0.02**2, x.T @ y / 0.02**2, prior, np.zeros(4 * n))
    assert set(found.changed) == {(POSITION, 10), ("anchor_delay", 50)}
    np.testing.assert_allclose(found.step, truth, atol=0.05)


def test_anchors_that_are_not_heard_together_have_no_part_in_each_others_deviations(both):
    _, sparse, candidates = both
    one = named(candidates, "anchor_delay", ("2",))
    near = deviations._heard_with(sparse, fit(sparse, columns_of([one])))
    assert near == set(map(str, clean_flight(100, 30.0).anchors.ids))
    assert EFFECTS["anchor_delay"].name == one.name
