# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tables, fits, selection, held-out checks and confounding, on small tables of known content."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

from hypothesis import given, settings, strategies as st
from known_effects import clean_flight, effect_of
import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.effects import EFFECTS, EffectSet, SmoothTerm
from uwb_tdoa_ekf.evidence import MOVED, POSITION, Part, eliminated, with_each_change
from uwb_tdoa_tools.diagnosis import deviations
from uwb_tdoa_tools.diagnosis.channels import CHANNELS, residuals
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.diagnosis.refinement import effects_of, with_fewer_pairs
from uwb_tdoa_tools.diagnosis.regression import confounding
from uwb_tdoa_tools.diagnosis.regression.confounding import (
    alternatives,
    flight_to_tell,
    unobservable,
)
from uwb_tdoa_tools.diagnosis.regression.fit import APPLIED_STD, fit, refit
from uwb_tdoa_tools.diagnosis.regression.held_out import held_out
from uwb_tdoa_tools.diagnosis.regression.scorer import Scorer
from uwb_tdoa_tools.diagnosis.regression.select import SAME, Rival, rank, select
from uwb_tdoa_tools.diagnosis.regression.table import table_of
from uwb_tdoa_tools.diagnosis.regression.terms import Candidate, Term, candidates_of, columns_of
from uwb_tdoa_tools.diagnosis.self_calibration.prior import Prior, posterior, solve

# --- regression ---

PAIRS = np.array([[k, (k + 1) % 8] for k in range(8)])


def table_with(
    *flights,
    names=("anchor_delay", "pair_offset", "anchor_position", "gyro_bias", "accel_bias"),
    pairs=PAIRS,
):
    """Return (Table, [Candidate]) of flights with the columns of some effects."""
    parts = [residuals(flight, GroundTruth(), EffectSet()) for flight in flights]
    candidates = [
        c for name in names for c in candidates_of(EFFECTS[name](), flights[0].anchors, pairs)
    ]
    table = table_of(parts).with_terms(
        [term for candidate in candidates for term in candidate.terms]
    )
    return table, candidates


@pytest.fixture(scope="module")
def clean():
    return table_with(clean_flight(100, 30.0))


@pytest.fixture(scope="module")
def late():
    return table_with(effect_of("anchor_delay", True, 1).inject(clean_flight(100, 30.0)))


@pytest.fixture(scope="module")
def selection(late):
    """Return the Selection of the flight with a late anchor."""
    table, candidates = late
    return select(table, candidates, fit(table, columns_of(candidates)).inflation)


def named(candidates, name, keys=None):
    return next(
        c for c in candidates if c.name == name and (keys is None or c.terms[0].keys == keys)
    )


def test_a_table_is_not_changed_by_a_wider_one(clean):
    table, candidates = clean
    before = table.matrix(table.columns), dict(table.columns), table.y.copy()
    nlos = EFFECTS["nlos"]({"3.start": 2.0, "3.end": 9.0})
    wider = table.with_terms([Term(nlos, ("3.delay",))])
    assert len(wider.columns) == len(table.columns) + 1
    np.testing.assert_array_equal(table.matrix(table.columns), before[0])
    assert list(table.columns) == list(before[1])
    assert all(
        wider.columns[column] is values for column, values in before[1].items()
    )  # shared, not copied
    contributed = wider.with_contribution(
        [(EFFECTS["anchor_delay"]({"2": 0.5}), named(candidates, "anchor_delay", ("2",)).columns)]
    )
    np.testing.assert_array_equal(table.y, before[2])
    assert np.abs(contributed.y - table.y).max() == pytest.approx(0.5)


def test_rows_of_a_channel_lie_together(clean):
    table, _ = clean
    for number, name in enumerate(table.channels):
        rows = table.rows_of(name)
        assert (table.channel[rows] == number).all() and np.sum(
            table.channel == number
        ) == rows.stop - rows.start


def test_columns_of_one_parameter_are_one_column(clean):
    _, candidates = clean
    everyone, alone = named(candidates, "anchor_delay"), named(candidates, "anchor_delay", ("2",))
    assert set(alone.columns) < set(everyone.columns)
    one, other = (EFFECTS["nlos"]({"3.start": start}) for start in (1.0, 2.0))
    assert Term(one, ("3.delay",)).columns != Term(other, ("3.delay",)).columns


@cache
def short():
    return table_with(
        clean_flight(100, 20.0), names=("anchor_delay", "gyro_bias", "anchor_position")
    )


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_the_scorer_gives_what_the_whole_equations_would(data):
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    table, candidates = short()
    base = columns_of(data.draw(st.lists(st.sampled_from(candidates), max_size=2)))
    candidate = data.draw(st.sampled_from(candidates))
    model = fit(table, base, np.ones(3 * len(CHANNELS)))
    model = type(model)(**{**vars(model), "weight": rng.uniform(0.5, 1.5, len(table.y))})
    judged = Scorer(table, base, model, candidate.columns).gain(candidate.columns)
    both = list(dict.fromkeys([*base, *candidate.columns]))
    if set(candidate.columns) <= set(base):
        assert judged is None
        return
    information, x, sizes = (
        model.information(table),
        table.matrix(both),
        np.array([c.typical for c in both]),
    )
    gram = (x * information[:, None]).T @ x + np.diag(sizes**-2)
    beta = np.linalg.solve(gram, x.T @ (information * table.y))
    place = {column: k for k, column in enumerate(both)}
    np.testing.assert_allclose(
        judged.beta, beta[[place[column] for column in candidate.columns]], rtol=1e-6, atol=1e-9
    )
    told = len(both) - np.trace(np.linalg.inv(gram) / np.outer(sizes, sizes))
    assert judged.determined == pytest.approx(
        told - Scorer(table, base, model, [])._determined, abs=1e-6
    )


def test_a_delay_is_ranked_first_and_a_clean_flight_has_nothing(clean, selection):
    table, candidates = clean
    model = fit(table, [], np.ones(3 * len(CHANNELS)))
    assert all(criterion < 0.0 for criterion, _ in rank(table, candidates, [], model))
    assert [candidate.name for candidate in selection.chosen] == ["anchor_delay"]


def test_what_is_implausible_is_not_chosen(late):
    table, candidates = late
    model = fit(table, [], np.ones(3 * len(CHANNELS)))
    nlos = EFFECTS["nlos"]
    early = Candidate((Term(nlos({"1.start": 0.0, "1.end": 60.0}), ("1.delay",)),))
    assert not early.plausible(np.array([-0.3])) and early.plausible(np.array([0.3]))
    assert not named(candidates, "anchor_delay", ("1",)).plausible(np.array([6.0]))
    assert not named(candidates, "anchor_delay", ("1",)).sizable(np.array([0.001]))
    assert model.columns == ()


def test_held_out_gain_is_large_for_what_is_there_and_none_for_what_is_not(late, selection):
    (there,) = held_out(selection)
    assert there.gain > 50.0 and there.t > 3.0 and there.explained > 0.3
    with_idle = selection.plus(named(late[1], "gyro_bias", ("x",)))
    assert held_out(with_idle)[-1].gain < 2.0


def test_a_share_of_the_values_is_applied(late):
    table, candidates = late
    columns = named(candidates, "anchor_delay").columns
    model = fit(table, columns)
    whole, part = (refit(table, columns, model, share=share) for share in (1.0, 0.7))
    np.testing.assert_allclose(part.beta, 0.7 * whole.beta)
    np.testing.assert_allclose(part.residual, table.y - table.matrix(columns) @ part.beta)


def test_a_refit_to_some_rows_does_not_look_at_the_others(late):
    table, candidates = late
    columns = named(candidates, "anchor_delay").columns
    model = fit(table, columns)
    half = table.block % 2 == 0
    spoilt = replace(table, y=np.where(half, table.y, 1e3))
    np.testing.assert_allclose(
        refit(table, columns, model, half).beta, refit(spoilt, columns, model, half).beta
    )


def test_what_is_kept_is_fitted_with_the_weights_of_all_that_was_chosen(late):
    table, candidates = late
    delay, idle = named(candidates, "anchor_delay"), named(candidates, "gyro_bias", ("x",))
    selection = select(table, [delay], fit(table, columns_of(candidates)).inflation).plus(idle)
    spoilt = replace(
        selection,
        fit=replace(
            selection.fit, weight=np.where(table.block % 2 == 0, selection.fit.weight, 1e-9)
        ),
    )
    kept = spoilt.kept([delay])
    assert kept.chosen == (delay,) and len(kept.loss) == len(kept.rivals) == 1
    half = refit(table, delay.columns, selection.fit, table.block % 2 == 0)
    np.testing.assert_allclose(kept.fit.beta, half.beta, rtol=1e-6)
    assert (np.diag(kept.fit.cov) >= np.diag(half.cov) * (1.0 - 1e-6)).all()
    assert np.abs(spoilt.only([delay]).fit.beta - half.beta).max() > 1e-4


def over(covariate, anchor="4"):
    term = SmoothTerm(covariate=covariate, form="anchor", knots=(-2.0, 2.0), shape="line")
    return Candidate((Term(term, term.keys_of((anchor,))),))


def test_of_functions_that_explain_alike_the_mean_is_kept(late):
    table, candidates = late
    delay, one, same, worse = named(candidates, "anchor_delay"), *map(over, ("x", "y", "height"))
    table = table.with_terms([each.terms[0] for each in (one, same, worse)])
    selection = select(table, [delay], fit(table, columns_of(candidates)).inflation).plus(one)
    rivals = (
        Rival(1.0, same, 0.5 * SAME),
        Rival(9.0, worse, 2.0 * SAME),
        Rival(-9.0, over("range"), -2.0 * SAME),
        Rival(0.0, over("elevation"), 0.0),
        Rival(1.0, over("y", "5"), 0.5 * SAME),
    )
    told = replace(selection, rivals=((), rivals))
    for share, rows in ((None, None), (0.7, table.block % 2 == 0)):
        kept = selection.beside(told).kept([delay, one], share, rows).fit
        several = [
            refit(table, columns_of([delay, each]), selection.fit, rows, share)
            for each in (one, same)
        ]
        residual = 0.5 * (several[0].residual + several[1].residual)
        np.testing.assert_allclose(kept.residual, residual, atol=1e-9)
        left = table.y - table.matrix(kept.columns) @ kept.beta
        np.testing.assert_allclose(kept.residual, left, atol=1e-9)
        np.testing.assert_allclose(kept.values(same.columns), 0.5 * several[1].values(same.columns))
    effects = effects_of(selection.beside(told).kept([delay, one]))
    assert [effect.arguments for effect in effects[1:]] == [("x",), ("y",)]
    assert len(effects_of(selection.kept([delay, one]))) == 2


def test_what_is_set_apart_stays_in_the_fit_of_the_others(late):
    """Without the delay in the fit, positions stand in for it."""
    table, candidates = late
    delay, position = named(candidates, "anchor_delay"), named(candidates, "anchor_position")
    selection = select(table, [delay], fit(table, columns_of(candidates)).inflation).plus(position)
    apart = selection.apart([delay])
    assert (apart.chosen, apart.own) == ((position,), (delay,))
    assert len(apart.loss) == len(apart.rivals) == 1
    alone, beside = (
        one.kept([position]).fit.values(position.columns) for one in (selection, apart)
    )
    both = refit(table, columns_of([delay, position]), selection.fit).values(position.columns)
    np.testing.assert_allclose(beside, both, atol=1e-9)
    assert np.linalg.norm(beside) < 0.8 * np.linalg.norm(alone)
    assert [effect.name for effect in effects_of(apart.kept([position]))] == ["anchor_position"]


def test_applied_positions_have_a_tight_prior_and_all_other_values_the_usual_one(late):
    table, candidates = late
    delay, position = named(candidates, "anchor_delay"), named(candidates, "anchor_position")
    columns = [*delay.columns, *position.columns]
    moved = np.arange(len(columns)) >= len(delay.columns)
    model = fit(table, columns)
    applied = refit(table, columns, model, share=1.0)
    x, information = table.matrix(columns), model.information(table)
    prior = np.where(moved, APPLIED_STD, EFFECTS["anchor_delay"].row.prior_std)
    gram = x.T @ (information[:, None] * x) + np.diag(prior**-2.0)
    expected = np.linalg.solve(gram, x.T @ (information * table.y))
    np.testing.assert_allclose(applied.beta, expected, atol=1e-9)
    searched = refit(table, columns, model)
    sizes = [np.linalg.norm(one.beta[moved]) for one in (applied, searched)]
    assert 0.0 < sizes[0] < sizes[1]
    alone = [refit(table, delay.columns, model, share=share).beta for share in (1.0, None)]
    np.testing.assert_array_equal(*alone)


def test_an_alternative_is_named_where_the_flight_cannot_tell(late, selection):
    names = {one.effect for one in alternatives(selection, selection.chosen[0], late[1])}
    assert "pair_offset" in names  # TDoA2: a delay of an anchor equals two pair offsets
    assert "gyro_bias" not in names


LATE = {str(k): value for k, value in enumerate((0.3, -0.2, 0.1, 0.25, -0.3, 0.2, -0.1, -0.25))}


def with_all_pairs(*effects, seed=100):
    """Return (Selection of the offsets of all pairs, its declared Candidates) of a flight with Effects.

    seed : of the flight; 100 hears a ring, 102 all pairs
    """
    flight = clean_flight(seed, 30.0)
    for effect in effects:
        flight = effect.inject(flight)
    pairs = np.unique(np.sort(np.column_stack([flight.tdoa.a, flight.tdoa.b]), axis=1), axis=0)
    heard = PAIRS if seed == 100 else pairs
    table, candidates = table_with(flight, names=("anchor_delay", "pair_offset"), pairs=heard)
    group = named(candidates, "pair_offset")
    assert len(group.columns) == len(heard)
    return select(table, [group], fit(table, columns_of(candidates)).inflation), candidates


def test_offsets_of_a_ring_are_delays_of_anchors_and_one_offset():
    """Flights that hear other pairs have the delays, too; offsets of the ring tell them nothing."""
    offset = EFFECTS["pair_offset"]({"7-0": 0.3})
    selection, declared = with_all_pairs(EFFECTS["anchor_delay"](LATE), offset)
    delays, offsets = effects_of(with_fewer_pairs(selection, declared))
    assert (delays.name, offsets.name) == ("anchor_delay", "pair_offset")
    assert len(offsets.values) == 1
    (of_pair,) = offsets.values.values()
    assert abs(of_pair) == pytest.approx(0.3, abs=0.03)  # of any pair: the sum around the ring
    selection, declared = with_all_pairs(EFFECTS["anchor_delay"](LATE))
    (delays,) = effects_of(with_fewer_pairs(selection, declared))
    mean = np.mean(list(delays.values.values()))
    assert {k: v - mean for k, v in delays.values.items()} == pytest.approx(LATE, abs=0.02)


def test_offsets_of_few_pairs_stay_offsets_of_these():
    put_in = {"0-1": 0.3, "2-3": 0.25, "4-5": 0.35, "6-7": -0.3}
    selection, declared = with_all_pairs(EFFECTS["pair_offset"](put_in))
    (offsets,) = effects_of(with_fewer_pairs(selection, declared))
    assert offsets.values == pytest.approx(put_in, abs=0.02)


def test_offsets_of_many_pairs_that_no_delay_explains_stay():
    sizes = np.random.default_rng(1).uniform(0.1, 0.4, (8, 8)) * (-1.0) ** np.arange(8)
    put_in = {f"{a}-{b}": float(sizes[a, b]) for a in range(8) for b in range(a + 1, 8)}
    selection, declared = with_all_pairs(EFFECTS["pair_offset"](put_in), seed=102)
    assert with_fewer_pairs(selection, declared) is selection


def test_what_no_tdoa_can_tell_is_named(late, selection):
    hidden = unobservable(selection, late[1])
    assert any(
        item.effect == "anchor_delay" and len(item.direction) == 8 for item in hidden
    )  # the common delay of all anchors
    assert any(
        item.effect == "range_scale" and item.direction is None for item in hidden
    )  # has no column here


def test_a_flight_that_tells_is_the_same_both_ways():
    assert flight_to_tell("nlos", "anchor_delay") == flight_to_tell("anchor_delay", "nlos")
    assert "flight" in flight_to_tell("gyro_bias", "pair_offset")


def test_alternatives_that_explain_as_much_have_the_order_of_their_names(monkeypatch):
    """The order of a set would differ from process to process."""
    names = ["pair_offset", "anchor_delay", "range_bias", "nlos", "range_scale"]
    monkeypatch.setattr(confounding, "_shares", lambda *_: dict.fromkeys(names, 0.95))
    chosen = Candidate((Term(EFFECTS["anchor_position"](), ()),))
    selection = SimpleNamespace(chosen=(chosen,), rivals=((),))
    assert [other.effect for other in alternatives(selection, chosen, [])] == sorted(names)


# --- algebra ---


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
