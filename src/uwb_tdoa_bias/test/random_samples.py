# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Random attitudes, and random TDOAs with the poses of the tag."""

from dataclasses import fields

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.effects import RangeSamples, Samples


def random_rotation(rng):
    """Return a random attitude; all attitudes are equally likely."""
    return Rotation.from_quat(rng.standard_normal(4))


def random_samples(seed, n=20, n_anchors=5):
    """Return Samples of n TDOAs between anchors in a cube of 10 m, with known attitudes."""
    rng = np.random.default_rng(seed)
    anchors = Anchors(
        rng.permutation(100)[:n_anchors],
        rng.uniform(-5, 5, (n_anchors, 3)),
        rng.standard_normal((n_anchors, 4)),
    )
    a = rng.integers(0, n_anchors, n)
    b = (a + rng.integers(1, n_anchors, n)) % n_anchors
    q = Rotation.from_quat(rng.standard_normal((n, 4))).as_quat() if n else np.empty((0, 4))
    p, v = rng.uniform(-5, 5, (n, 3)), rng.standard_normal((n, 3))
    return Samples(np.arange(n) / 100.0, a, b, p, q, anchors, velocity=v)


def ranges_of(samples, rows):
    """Return RangeSamples: distances to the anchors in `rows` (n,)."""
    own = {one.name: getattr(samples, one.name) for one in fields(samples)}
    return RangeSamples(**{**own, "a": rows, "b": rows})
