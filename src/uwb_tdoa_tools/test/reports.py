# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Helpers for the tests of reports: artificial findings and diagnoses, and parsed pages."""

from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
import re

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS
from uwb_tdoa_tools.diagnosis.findings import EffectFinding
from uwb_tdoa_tools.diagnosis.regression.terms import Candidate, Term

# Keys of diagnosis.json whose content has names as keys: parameters, anchors, lags.
NAMES_BELOW = {"parameters", "std", "direction", "values", "autocorrelation"}


def said(page):
    """Return the text of a page, without markup."""
    text = unescape(re.sub(r"<style>.*?</style>|<[^>]*>", " ", page, flags=re.S))
    return " ".join(text.replace("m/s²", "m/s^2").split())


def finding(effect, added=True, worth=0.02, alternatives=(), tried=True, channel="tdoa"):
    candidates = (Candidate((Term(effect, tuple(effect.std)),)),) if tried else ()
    return EffectFinding(effect, channel, {}, 0.1, tuple(alternatives), candidates, added, worth)


def delay(value=0.3, std=0.01):
    return EFFECTS["anchor_delay"]({"3": value}, {"3": std})


def run(name, error, diverged=False):
    return {
        "flight": name,
        "rmse_3d": error,
        "diverged": diverged,
        "rmse_3d_ci": [0.9 * error, 1.1 * error],
    }


def judged(result, before, after, gain, **changes):
    """Return the Diagnosis with other errors.

    before, after : {flight: error, m}
    gain : confidence interval of the gain, m
    """
    sides = []
    for errors in (before, after):
        runs = [
            run(name, *(value if isinstance(value, tuple) else (value,)))
            for name, value in errors.items()
        ]
        pooled = {"rmse_3d": float(np.sqrt(np.mean([item["rmse_3d"] ** 2 for item in runs])))}
        pooled["rmse_3d_ci"] = [0.9 * pooled["rmse_3d"], 1.1 * pooled["rmse_3d"]]
        sides.append({"runs": runs, "pooled": pooled, "scores": result.before["scores"]})
    sides[1]["pooled"]["rmse_3d_gain_ci"] = gain
    return replace(result, before=sides[0], after=sides[1], **changes)


def keys_of(content):
    if isinstance(content, list):
        return set().union(*map(keys_of, content))
    if not isinstance(content, dict):
        return set()
    return set(content).union(
        *(keys_of(item) for key, item in content.items() if key not in NAMES_BELOW)
    )


class Tags(HTMLParser):
    """Collect all tags of a page.

    seen : [(tag, attributes, enclosing tags)]
    open : tags that are not closed
    """

    def __init__(self, page):
        super().__init__()
        self.open, self.seen = [], []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.seen.append((tag, dict(attrs), list(self.open)))
        if tag not in ("meta", "br", "img", "source"):
            self.open.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag
