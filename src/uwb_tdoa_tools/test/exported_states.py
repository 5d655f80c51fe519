# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Random states of a tag, every effect that a file can hold, and networks of the paper's shape."""

from dataclasses import fields, replace

from known_effects import SIZES, effect_of
import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.correction.model import FEATURES, Network
from uwb_tdoa_bias.correction.session import Session
from uwb_tdoa_bias.effects import EFFECTS, Samples, SmoothTerm
from uwb_tdoa_bias.effects.samples import CATEGORIES, OF_ARRIVAL, OF_TDOA, Motion
from uwb_tdoa_bias.effects.smooth_term import FACTORS, OF_LINKS, SHAPES
from uwb_tdoa_tools.exporting.tracing import is_traceable
from uwb_tdoa_tools.training import models as training

# Ranges of the covariates of a tag in `anchors_of`: (lowest, highest)
RANGES = {
    "time": (0.0, 300.0),
    "x": (-1.0, 9.0),
    "y": (-1.0, 8.0),
    "height": (0.0, 4.0),
    "speed": (0.0, 4.0),
    "climb_rate": (-3.0, 3.0),
    "acceleration": (0.0, 6.0),
    "turning_rate": (0.0, 4.0),
    "tilt": (0.0, 3.0),
    "interval": (0.0, 0.02),
    "previous_anchor": (0.0, 7.0),
    "range": (0.0, 12.0),
    "range_difference": (-8.0, 8.0),
    "range_rate": (-3.0, 3.0),
}
ANGLE = (-3.0, 3.0)  # rad, range of the other covariates


def anchors_of(count=8, seed=3):
    """Return the Anchors of a hall with any orientations and ids 0, 1, ..."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform([0, 0, 0], [8, 7, 3.5], (count, 3))
    return Anchors(np.arange(count), positions, rng.standard_normal((count, 4)))


def states(anchors, n=10_000, seed=0):
    """Return Samples of any pairs in any state.

    One in twenty lacks its pose, attitude or motion. One in ten has an unknown yaw.
    """
    rng, count = np.random.default_rng(seed), len(anchors)
    a = rng.integers(0, count, n)
    b = (a + rng.integers(1, count, n)) % count
    p = rng.uniform([-1, -1, 0], [9, 8, 4], (n, 3))
    p[rng.random(n) < 0.3, 2] *= 0.05  # on the floor
    q = Rotation.random(n, random_state=seed).as_quat()
    motion = [rng.normal(0.0, scale, (n, 3)) for scale in (1.0, 2.0, 1.5)]
    lost = rng.random(n)
    p[lost < 0.05] = np.nan
    q[lost < 0.1] = np.nan
    for part in motion:
        part[lost > 0.95] = np.nan
    return Samples(
        rng.uniform(0.0, 300.0, n),
        a,
        b,
        p,
        q,
        anchors,
        motion=Motion(*motion),
        interval=rng.uniform(0.0, 0.02, n),
        previous=anchors.ids[rng.integers(0, count, n)],
        yaw_std=np.where(rng.random(n) < 0.1, 1.5, 0.1),
    )


def rows_of(samples, some):
    """Return the Samples of some rows, with their Motion."""
    known = {one.name: getattr(samples, one.name) for one in fields(samples)}
    values = {
        name: value[some] if isinstance(value, np.ndarray) else value
        for name, value in known.items()
    }
    motion = Motion(*(value[some] for value in vars(samples.motion).values()))
    return replace(samples, **{**values, "motion": motion})


def smooth_terms(anchors):
    """Return {label: SmoothTerm}: all covariates in all forms, and all shapes."""
    out = {}
    for covariate in (*OF_TDOA, *OF_ARRIVAL):
        for form in ("common", "arrival", "anchor", "pair", "direction"):
            of_one = covariate in OF_ARRIVAL and form in (*OF_LINKS, "common")
            of_both = covariate in OF_TDOA and form == "arrival"  # the difference is zero
            if not of_one and not of_both and covariate != "vibration":
                out[f"{covariate} {form}"] = term(anchors, covariate, form)
    for shape in SHAPES:
        out[f"range {shape}"] = term(anchors, "range", "anchor", shape)
    for shape in FACTORS:
        out[f"range step, times height {shape}"] = product(anchors, "anchor", "height", shape)
    for form in ("common", "pair", "direction"):
        out[f"speed step, times height step, {form}"] = product(anchors, form, "height", "step")
    return out


def product(anchors, form, factor, shape):
    """Return a SmoothTerm of random coefficients with a factor."""
    one = term(anchors, "range" if form == "anchor" else "speed", form, "step")
    knots = tuple(np.linspace(*RANGES[factor], SHAPES[shape][0]).tolist())
    return replace(one, factor=factor, factor_shape=shape, factor_knots=knots)


def term(anchors, covariate, form, shape="spline"):
    """Return a SmoothTerm of random coefficients."""
    low, high = RANGES.get(covariate, ANGLE)
    count = SHAPES.get(shape, (None,))[0] or 5  # of a spline, or switching: any number
    names = covariate in CATEGORIES
    knots = anchors.ids.tolist() if names else np.linspace(low, high, count).tolist()
    parts = {"anchor": [str(i) for i in anchors.ids], "pair": ["0-1", "2-5"]}
    parts |= {"direction": ["0-1", "5-2"]}
    empty = SmoothTerm({}, {}, "", "tdoa", covariate, form, knots, shape)
    keys = empty.keys_of(parts.get(form, [""]))
    values = dict(zip(keys, np.random.default_rng(len(keys)).normal(0.0, 0.3, len(keys))))
    domain = {} if names else {covariate: (low, 0.7 * high)}
    return SmoothTerm(values, {}, "", "tdoa", covariate, form, knots, shape, domain=domain)


def exportable(anchors):
    """Return {label: effect} of all effects that a file can hold."""
    declared = {name: effect_of(name, True, 1) for name in SIZES if name in EFFECTS}
    kept = {name: effect for name, effect in declared.items() if is_traceable(effect)}
    return kept | smooth_terms(anchors)


def network_of(folder, names=FEATURES, seed=0, **more):
    """Return a Network of the paper's layers with random weights. more : its metadata."""
    rng, k = np.random.default_rng(seed), len(names)
    sizes = (k, *training.LAYERS, 1)
    layers = [
        (rng.normal(0.0, (1.5 / i) ** 0.5, (i, o)), rng.normal(0.0, 0.1, o))
        for i, o in zip(sizes, sizes[1:])
    ]
    made = training.Paper(
        names, rng.normal(0.0, 0.5, k), np.where(np.arange(k) < 6, 6.0, 3.0), layers, 0.06
    )
    meta = {"clip": 0.8, "name": "random", "data": "none", "validity": {}} | more
    path = folder / f"network{k}-{seed}.onnx"
    path.write_bytes(made.onnx(meta).SerializeToString())
    return Network(path, Session(path.read_bytes()))
