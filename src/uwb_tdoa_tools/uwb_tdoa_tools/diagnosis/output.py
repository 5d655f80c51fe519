"""A diagnosis for machines, and in a few lines."""

import numpy as np


def as_json(diagnosis):
    """What diagnosis.json holds: plain values."""
    return _plain(
        {
            "flights": [flight.name for flight in diagnosis.flights],
            "rests_on": diagnosis.reference.words,
            "findings": [_finding(finding) for finding in diagnosis.findings if finding.declared],
            "unattributed": [_function(finding) for finding in diagnosis.findings if not finding.declared],
            "ambiguous": _ambiguous(diagnosis),
            "unobservable": [
                {"effect": item.effect, "direction": item.direction or "the flights lack the channel that shows it"}
                for item in diagnosis.unobservable
            ],
            "refused": [{"what": item.what, "why": item.why} for item in diagnosis.refused],
            "before": {key: diagnosis.before[key] for key in ("runs", "pooled")},
            "after": {key: diagnosis.after[key] for key in ("runs", "pooled")},
            "judged_on": diagnosis.judged_on,
            "health": diagnosis.health,
        }
    )


def as_text(diagnosis):
    """Lines for the screen: findings, what has no name, what is unclear, before and after."""
    lines = []
    for finding in diagnosis.findings:
        if finding.declared:
            what = f"found     {finding.effect.name}: {parameters_of(finding)}{_share(finding)}"
        else:
            effect = finding.effect
            what = f"no name   {effect.channel} over {effect.covariate} ({effect.form}){_share(finding)}"
        lines.append(what + _worth(finding))
    if not lines:
        lines.append("nothing found: the residuals look like noise")
    for case in _ambiguous(diagnosis):
        others = ", ".join(other["effect"] for other in case["alternatives"])
        tell = case["alternatives"][0]["tell_apart"]
        lines.append(f"unclear   {case['found']} could as well be {others}; to tell: {tell}")
    before, after = diagnosis.before["pooled"], diagnosis.after["pooled"]
    if before.get("rmse_3d") is not None:
        lines.append(f"3D RMSE   {before['rmse_3d']:.3f} -> {after['rmse_3d']:.3f} m, on {diagnosis.judged_on}")
    else:
        lines.append(f"innovations' spread {before['residual_spread']:.3f} -> {after['residual_spread']:.3f} m")
    return "\n".join(lines)


def parameters_of(finding, most=6):
    """Values of a Finding with their standard deviations: text."""
    effect = finding.effect
    values = [
        f"{key} = {value:.4g}" + (f" +- {effect.std[key]:.2g}" if key in effect.std else "")
        for key, value in list(effect.values.items())[:most]
    ]
    more = len(effect.values) - len(values)
    return ", ".join(values) + (f", and {more} more" if more > 0 else "") + f" ({effect.unit})"


def _share(finding):
    """Of the variance of a channel that it alone explains; what others explain as well, and noise, is no share."""
    return f", alone explains {finding.explained:.0%} of {finding.channel}" if finding.explained >= 0.005 else ""


def _worth(finding):
    if not finding.added:
        reason = "the filter does as well without it" if finding.effect.usable else "nodes cannot take it out"
        return f", not added: {reason}"
    return "" if finding.worth is None else f", worth {100.0 * finding.worth:.1f} cm"


def _finding(finding):
    effect = finding.effect
    return {
        "effect": effect.name,
        "parameters": dict(effect.values),
        "std": dict(effect.std),
        "unit": effect.unit,
        "channel": finding.channel,
        "evidence": finding.evidence,
        "variance_explained": finding.explained,
        "worth": finding.worth,
        "confounded_with": [
            {"effect": other.effect, "share": other.share, "tell_apart": other.tell_apart}
            for other in finding.alternatives
            if other.share is not None
        ],
        "could_be_mistaken_for": list(effect.confounded_with),
        "added": finding.added,
    }


def _function(finding):
    effect = finding.effect
    at = np.linspace(effect.knots[0], effect.knots[-1], 25)
    prefixes = sorted({key.rpartition("c")[0] for key in effect.values})
    return {
        "channel": effect.channel,
        "covariate": effect.covariate,
        "form": effect.form,
        "strength": finding.explained,
        "worth": finding.worth,
        "evidence": finding.evidence,
        "together_with": list(finding.together_with),
        "shape": {"at": at, "values": {prefix.rstrip("."): effect.curve(at, prefix) for prefix in prefixes}},
        "usable": effect.usable,
        "added": finding.added,
    }


def _ambiguous(diagnosis):
    """Findings that another effect would explain nearly as well."""
    out = []
    for finding in diagnosis.findings:
        near = [other for other in finding.alternatives if other.gap is not None]
        if finding.declared and near:
            out.append(
                {
                    "found": finding.effect.name,
                    "alternatives": [
                        {"effect": other.effect, "criterion_gap": other.gap, "tell_apart": other.tell_apart}
                        for other in sorted(near, key=lambda other: other.gap)
                    ],
                }
            )
    return out


def _plain(value):
    """numpy and non-finite numbers as JSON has them."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(item) for item in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value
