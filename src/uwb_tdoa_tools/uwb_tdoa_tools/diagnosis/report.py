"""The diagnosis in words and pictures."""

import base64
import html as escape_html
import io
from types import SimpleNamespace

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS

_STYLE = """body{font:15px/1.5 sans-serif;max-width:62em;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;margin:.6em 0}td,th{border:1px solid #bbb;padding:.25em .6em;text-align:left}
th{background:#eee}img{max-width:100%}h2{margin-top:1.8em}.good{color:#060}.bad{color:#900}small{color:#555}"""


def html(diagnosis):
    """One page with everything in it."""
    result = SimpleNamespace(**diagnosis.as_json(), residuals=diagnosis.attribution.residuals, remaining=diagnosis.remaining)
    parts = [f"<h1>Diagnosis of {_e(', '.join(result.flights))}</h1>", f"<pre>{_e(diagnosis.as_text())}</pre>"]
    parts += ["<h2>Before and after</h2>", _errors(result), _picture(_plot_errors, result)]
    parts += ["<h2>Effects that were found</h2>", _findings(result)]
    parts += [
        "<h2>Structure without a name</h2>",
        _terms(result),
        _picture(_plot_terms, result) if result.unattributed else "",
    ]
    parts += [
        "<h2>What the residuals look like</h2>",
        "<p>Measured minus model at the true place, grey before, blue after. "
        "A good model leaves a narrow band about zero that does not wander.</p>",
        _picture(_plot_residuals, result),
        _picture(_plot_pairs, result),
    ]
    parts += ["<h2>What these flights cannot tell</h2>", _unclear(result)]
    parts += [
        "<h2>Looked at and not added</h2>",
        _table(["what", "why"], [[r["what"], r["why"]] for r in result.refused]),
    ]
    parts += ["<h2>Health of the channels</h2>", _health(result.health)]
    head = f"<!doctype html><html lang='en'><meta charset='utf-8'><title>Diagnosis</title><style>{_STYLE}</style>"
    return f"{head}<body>{''.join(parts)}</body></html>"


def _e(value):
    return escape_html.escape(str(value))


def _share(found):
    """Of the variance of a channel; noise explains none."""
    share = found["variance_explained"]
    return f", explains {share:.0%} of {found['channel']}" if share else ""


def _table(head, rows):
    if not rows:
        return "<p>None.</p>"
    cells = "".join("<tr>" + "".join(f"<td>{_e(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return "<table><tr>" + "".join(f"<th>{_e(cell)}</th>" for cell in head) + f"</tr>{cells}</table>"


def _parameters(found, most=6):
    values = [
        f"{key} = {value:.4g}" + (f" ± {found['std'][key]:.2g}" if key in found["std"] else "")
        for key, value in list(found["parameters"].items())[:most]
    ]
    more = len(found["parameters"]) - len(values)
    return ", ".join(values) + (f", and {more} more" if more > 0 else "") + f" ({found['unit']})"


def _errors(result):
    keys = {
        "rmse_x": "x",
        "rmse_y": "y",
        "rmse_z": "z",
        "rmse_3d": "3D",
        "residual_spread": "residual spread",
        "nis_mean": "NIS (1)",
        "nees_mean": "NEES (3)",
    }
    rows = []
    for one, two in zip(
        [*result.before["runs"], result.before["pooled"]], [*result.after["runs"], result.after["pooled"]]
    ):
        cells = [_change(one.get(key), two.get(key)) for key in keys]
        rows.append(
            [one.get("flight", "pooled"), *cells, _interval(one.get("rmse_3d_ci")), _interval(two.get("rmse_3d_ci"))]
        )
    head = ["flight", *(f"{name} before -> after" for name in keys.values()), "95 % of 3D before", "after"]
    return f"<p>On {_e(result.judged_on)}; RMSE in metres.</p>" + _table(head, rows)


def _change(one, two):
    return "" if one is None or two is None else f"{one:.3f} -> {two:.3f}"


def _interval(value):
    return "" if value is None else f"{value[0]:.3f} ... {value[1]:.3f}"


def _findings(result):
    rows = []
    for found in result.findings:
        mistaken = "; ".join(
            f"{c['effect']} ({c['share']:.0%}): fly {c['tell_apart']}" for c in found["confounded_with"]
        )
        evidence = ", ".join(f"{key} {value}" for key, value in found["evidence"].items())
        rows.append(
            [
                found["effect"],
                EFFECTS[found["effect"]].physics,
                _parameters(found, 30) + _share(found),
                evidence,
                mistaken or "nothing in these flights",
                "yes" if found["added"] else "no",
            ]
        )
    return _table(["effect", "what it is", "parameters", "evidence", "could here be mistaken for", "added"], rows)


def _terms(result):
    rows = [
        [
            t["channel"],
            t["covariate"],
            t["form"],
            f"{t['strength']:.0%}",
            ", ".join(t["together_with"]),
            "yes" if t["added"] else ("no" if t["usable"] else "no: the nodes do not have this quantity"),
        ]
        for t in result.unattributed
    ]
    note = (
        "<p>Smooth functions of what was measured, for which the catalogue has no name. "
        "Strength: share of the variance of held-out data.</p>"
    )
    return note + _table(["channel", "over", "form", "strength", "together with", "added"], rows)


def _unclear(result):
    rows = [
        [
            case["found"],
            ", ".join(f"{o['effect']} (gap {o['criterion_gap']:.1f})" for o in case["alternatives"]),
            case["alternatives"][0]["tell_apart"],
        ]
        for case in result.ambiguous
    ]
    directions = [
        [
            u["effect"],
            u["direction"]
            if isinstance(u["direction"], str)
            else ", ".join(f"{k}: {w}" for k, w in u["direction"].items()),
        ]
        for u in result.unobservable
    ]
    return (
        "<p>Findings that other effects would explain nearly as well:</p>"
        + _table(["found", "could be", "a flight that tells"], rows)
        + (
            "<p>Combinations of parameters that leave no trace in these flights, and were not fitted:</p>"
            + _table(["effect", "direction"], directions)
        )
    )


def _health(health):
    def figures(item, name):
        auto = item.get("autocorrelation") or {}
        near = next(iter(auto.values()), None)
        return [
            item[name],
            item["count"],
            f"{item['bias']:.4f}",
            f"{item['spread']:.4f}",
            f"{item['tails']:.1%}",
            "" if near is None else f"{near:.2f}",
        ]

    head = ["count", "bias", "spread", "beyond 4 spreads", "autocorrelation at 0.1 s"]
    out = _table(["pair", *head], [figures(item, "pair") for item in health["pairs"]])
    out += _table(["anchor", *head], [figures(item, "anchor") for item in health["anchors"]])
    out += _table(["axis", *head], [figures(item, "axis") for item in health["axes"]])
    rows = [
        [
            f["flight"],
            f"{f['nis_mean']:.2f}",
            f"{f['nis_below_3.84']:.0%}",
            f"{f['nees_mean']:.2f}",
            f"{f['nees_below_7.81']:.0%}",
        ]
        for f in health["filter"]
    ]
    out += _table(["flight", "NIS mean (1)", "NIS within 95 % bound", "NEES mean (3)", "NEES within 95 % bound"], rows)
    crossed = [[" and ".join(c["pairs"]), c["correlation"]] for c in health["cross_correlation"]]
    return out + "<p>Pairs whose residuals go together:</p>" + _table(["pairs", "correlation"], crossed)


def _picture(draw, result):
    from ..scoring.plots import plt

    figure = draw(result, plt)
    if figure is None:
        return ""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=90)
    plt.close(figure)
    return f"<p><img alt='' src='data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}'></p>"


def _plot_errors(result, plt):
    runs = list(zip(result.before["runs"], result.after["runs"]))
    if runs[0][0].get("rmse_3d") is None:
        return None
    figure, ax = plt.subplots(figsize=(10, 1.2 + 0.4 * len(runs)), layout="constrained")
    at = np.arange(len(runs))
    for shift, side, name, colour in ((-0.2, 0, "before", "0.6"), (0.2, 1, "after", "tab:blue")):
        value = np.array([run[side]["rmse_3d"] for run in runs])
        ends = [run[side]["rmse_3d_ci"] or [v, v] for run, v in zip(runs, value)]
        error = np.abs(np.array(ends).T - value)
        ax.barh(at + shift, value, 0.38, xerr=error, color=colour, label=name)
    ax.set(yticks=at, yticklabels=[run[0]["flight"] for run in runs], xlabel="3D RMSE [m], with 95 % intervals")
    ax.invert_yaxis()
    ax.legend()
    return figure


def _plot_terms(result, plt):
    terms = result.unattributed[:6]
    figure, axes = plt.subplots(
        1, len(terms), figsize=(4 * min(len(terms), 3.5), 3.2), layout="constrained", squeeze=False
    )
    for ax, term in zip(axes[0], terms):
        for name, values in term["shape"]["values"].items():
            ax.plot(term["shape"]["at"], values, label=f"anchor {name}" if name else None)
        ax.set(xlabel=term["covariate"].replace("_", " "), title=term["channel"], ylabel="contribution")
        if len(term["shape"]["values"]) > 1:
            ax.legend(fontsize="x-small")
        ax.grid(alpha=0.3)
    return figure


def _plot_residuals(result, plt):
    sides = [_series(found[0]) for found in (result.residuals, result.remaining)]
    names = [name for name in sides[0] if name in sides[1]]
    figure, axes = plt.subplots(
        len(names), 1, figsize=(11, 1.7 * len(names) + 0.6), layout="constrained", sharex=True, squeeze=False
    )
    for ax, name in zip(axes[:, 0], names):
        for side, colour, label in zip(sides, ("0.65", "tab:blue"), ("before", "after")):
            ax.plot(*side[name], ".", ms=1.5, color=colour, label=label)
        limit = 1.3 * np.quantile(np.abs(sides[0][name][1]), 0.99) + 1e-9
        ax.set(ylabel=name, ylim=(-limit, limit))
        ax.grid(alpha=0.3)
    axes[-1, 0].set_xlabel(f"time [s], {result.flights[0]}")
    axes[0, 0].legend(loc="upper right", markerscale=6)
    return figure


def _series(flight):
    """{channel: (stamps, residuals)} of {channel: ChannelResidual}."""
    return {label: series for part in flight.values() for label, series in part.series().items()}


def _plot_pairs(result, plt):
    ids = result.residuals[0]["tdoa"].samples.anchors.ids
    sides = []
    for found in (result.residuals, result.remaining):
        groups = {}
        for one in found:
            chosen, samples = one["tdoa"].airborne, one["tdoa"].samples
            label = ids[samples.a[chosen]] * 1000 + ids[samples.b[chosen]]
            for pair in np.unique(label):
                groups.setdefault(int(pair), []).append(one["tdoa"].residual[chosen][label == pair])
        sides.append({pair: np.concatenate(values) for pair, values in groups.items()})
    pairs = sorted(sides[0], key=lambda pair: -len(sides[0][pair]))[:16]
    figure, ax = plt.subplots(figsize=(11, 3.6), layout="constrained")
    for shift, side, colour in ((-0.2, sides[0], "0.65"), (0.2, sides[1], "tab:blue")):
        boxes = ax.boxplot(
            [side.get(pair, [0.0]) for pair in pairs],
            positions=np.arange(len(pairs)) + shift,
            widths=0.35,
            showfliers=False,
            patch_artist=True,
        )
        for box in boxes["boxes"]:
            box.set_facecolor(colour)
    ax.set(
        xticks=np.arange(len(pairs)),
        xticklabels=[f"{p // 1000}-{p % 1000}" for p in pairs],
        xlabel="pair",
        ylabel="TDOA residual [m]",
    )
    ax.axhline(0.0, color="k", lw=0.6)
    ax.grid(alpha=0.3, axis="y")
    return figure
