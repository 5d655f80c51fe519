"""From flights to a model: which effects are there, how large, how sure, and what else it could be."""

from dataclasses import replace

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS, EffectSet

from . import floor, noise, scan
from .blocked import blocked_anchors
from .channels import residuals
from .findings import Attribution, Finding
from .fit import fit
from .heldout import held_out
from .rows import build, candidates
from .select import Candidate, Selection, columns_of, select, worth

ROUNDS = 2  # of linearising about what was found
MAPS_GAIN, MAPS_SURE = 20.0, 3.0  # held-out log-likelihood, twice, and its t value over blocks, that maps must bring
MIN_GAIN = 2.0  # held-out log-likelihood, twice, that a term must bring


def attribute(flights, base=EffectSet(), estimator=None, progress=None, undeclared=True, kinds=None):
    """Attribution of the residuals of Flights to effects beyond `base`.

    estimator(flight, effects) -> Odometry, to do without ground truth; progress() is called now and then;
    undeclared : scan too; kinds : names of the declared effects to look for, None for all.
    """
    tick = progress or (lambda: None)
    found = _residuals(flights, base, (), estimator)
    declared = [
        Candidate(effect.name, tuple((effect.name, key) for key in keys))
        for effect, keys in candidates(found)
        if kinds is None or effect.name in kinds
    ]
    search = blocked_anchors(flights[0].anchors) if kinds is None or "nlos" in kinds else None
    model, inflation = (), None
    for _ in range(ROUNDS):
        now = _residuals(flights, base, model, estimator)
        table = _table(now, model)
        if inflation is None:
            inflation = fit(table, columns_of(declared)).inflation
        tick()
        selection = select(table, declared, inflation, search, progress=tick)
        model = effects_of(selection)
        if not model:
            break
    refused = []
    selection = _only_held_out(table, selection, refused, len(flights))
    declared_chosen = list(selection.chosen)
    if undeclared:
        smooth = scan.candidates(now, table, scan.terms(now))
        tick()
        everything = smooth + declared
        after = select(table, everything, inflation, search, start=declared_chosen, progress=tick)
        if declared_chosen and any(one.terms for one in after.chosen):  # was the declared one a stopgap for the other?
            fresh = select(table, everything, inflation, search, progress=tick)
            after = max(after, fresh, key=lambda s: worth(table, s, len(everything)))
        selection = after
        selection = _only_held_out(table, selection, refused, len(flights))
        selection = _with_maps(table, selection, smooth, refused, len(flights))
    findings, terms = _findings(table, selection)
    left = _residuals(flights, base, [f.effect for f in findings + terms], estimator)
    near_floor = floor.finding(left)
    findings += noise.findings(left) + ([near_floor] if near_floor else [])
    return Attribution(findings, terms, found, left, table, selection, refused, declared)


def restricted(attribution, kept, noise):
    """The Attribution with only the Candidates `kept` and the findings `noise` of noise effects."""
    selection = attribution.selection
    places = [k for k, one in enumerate(selection.chosen) if any(one is other for other in kept)]
    now = fit(attribution.table, columns_of(kept), selection.fit.inflation)
    loss, rivals = [selection.loss[k] for k in places], [selection.rivals[k] for k in places]
    smaller = Selection([selection.chosen[k] for k in places], now, loss, rivals, selection.ranked)
    findings, terms = _findings(attribution.table, smaller)
    return replace(attribution, findings=findings + list(noise), terms=terms, selection=smaller)


def _with_maps(table, selection, smooth, refused, flights):
    """Add functions of the place for every anchor, if they are plainly worth it on held-out rows."""
    maps = scan.anchor_maps(smooth, selection.chosen)
    if maps is None:
        return selection
    chosen = [*selection.chosen, maps]
    now = fit(table, columns_of(chosen), selection.fit.inflation)
    tried = Selection(chosen, now, [*selection.loss, 0.0], [*selection.rivals, []], selection.ranked)
    scores = [held_out(table, tried)[-1]] + ([held_out(table, tried, by_flight=True)[-1]] if flights >= 3 else [])
    if min(score[0] for score in scores) > MAPS_GAIN and min(score[1] for score in scores) > MAPS_SURE:
        return tried
    if min(scores)[0] > 0.0:
        refused.append(
            (label_of(maps), f"does not help held-out data enough (log-likelihood {0.5 * min(scores)[0]:.1f})")
        )
    return selection


def _residuals(flights, base, model, estimator):
    effects = EffectSet((*base.effects, *model))
    return [residuals(flight, effects, estimator(flight, effects) if estimator else None) for flight in flights]


def _table(found, model):
    """Table linearised about `model`, whose contribution is put back: a fit gives whole values, not increments."""
    table = build(found, candidates(found), model)
    for effect in model:
        names = [(effect.name, key) for key in effect.values]
        if all(name in table.columns for name in names):
            table.y += table.matrix(names) @ np.array(list(effect.values.values()))
        else:  # a search's find: its columns are made anew
            for number, one in enumerate(found):
                rows = (table.flight == number) & (table.channel == 0)
                table.y[rows] += table.cells[number].means(effect.bias(one.tdoa.samples)[:, None])[:, 0]
    return table


def effects_of(selection):
    """The chosen Candidates with the values of the fit, one Effect per name, as a tuple."""
    values, std, order, terms = {}, {}, [], []
    index = {name: k for k, name in enumerate(selection.fit.names)}
    error = np.sqrt(np.diag(selection.fit.cov)) if index else []
    for one in selection.chosen:
        at = [index[name] for name in one.columns]
        mine = {key: float(selection.fit.beta[k]) for key, k in zip(one.keys, at)}
        spread = {key: float(error[k]) for key, k in zip(one.keys, at)}
        if one.terms:
            terms += _by_term(one, selection.fit, index, error)
            continue
        if one.effect not in order:
            order.append(one.effect)
        values.setdefault(one.effect, {}).update({**mine, **one.fixed})
        std.setdefault(one.effect, {}).update(spread)
    return tuple(EFFECTS[name](values[name], std[name], "diagnose") for name in order) + tuple(terms)


def _by_term(one, now, index, error):
    """(SmoothTerm with its values) for each term of a Candidate."""
    out = []
    for term in one.terms:
        mine = [name for name in one.columns if name[0] == scan.label(term)]
        values = {key: float(now.beta[index[label, key]]) for label, key in mine}
        std = {key: float(error[index[label, key]]) for label, key in mine}
        out.append(type(term)(values, std, "diagnose", term.channel, term.covariate, term.form, term.knots))
    return out


def _only_held_out(table, selection, refused, flights):
    """Drop, one by one, what does not help rows that it was not fitted on."""
    while selection.chosen:
        scores = held_out(table, selection)
        if flights >= 3:
            across = held_out(table, selection, by_flight=True)
            scores = [
                min(one, two) if one_is_shared(c) else one for one, two, c in zip(scores, across, selection.chosen)
            ]
        worst = min(range(len(scores)), key=lambda k: scores[k][0])
        if scores[worst][0] > MIN_GAIN:
            break
        one = selection.chosen[worst]
        refused.append((label_of(one), f"does not help held-out data (log-likelihood {0.5 * scores[worst][0]:.1f})"))
        chosen = selection.chosen[:worst] + selection.chosen[worst + 1 :]
        selection.chosen, selection.fit = chosen, fit(table, columns_of(chosen), selection.fit.inflation)
        del selection.loss[worst], selection.rivals[worst]
    return selection


def one_is_shared(candidate):
    """Whether it should hold on other flights too: not what happened at a time."""
    return not any(key.endswith((".start", ".end")) for key in candidate.fixed)


def label_of(one):
    """How a Candidate is called in reports."""
    return one.effect if not one.terms else f"{one.terms[0].channel} over {' + '.join(t.covariate for t in one.terms)}"


def _findings(table, selection):
    scores = held_out(table, selection)
    declared, terms = {}, []
    effects = effects_of(selection)
    named = {effect.name: effect for effect in effects if effect.name != "smooth_term"}
    smooth = [effect for effect in effects if effect.name == "smooth_term"]
    for one, (gain, t, share), loss, rivals in zip(selection.chosen, scores, selection.loss, selection.rivals):
        evidence = {"criterion": round(float(loss), 1), "held_out_gain": round(gain, 1), "held_out_t": round(t, 1)}
        if one.terms:
            parts, smooth = smooth[: len(one.terms)], smooth[len(one.terms) :]
            terms += [Finding(effect, effect.channel, evidence, share, one, rivals) for effect in parts]
            continue
        if one.effect in declared:
            before = declared[one.effect]
            before.evidence = {key: round(before.evidence[key] + evidence[key], 1) for key in evidence}
            before.variance_explained = max(before.variance_explained, share)
            before.rivals = before.rivals + rivals
            continue
        effect = named[one.effect]
        declared[one.effect] = Finding(effect, effect.channels[0], evidence, share, one, rivals)
    return list(declared.values()), terms
