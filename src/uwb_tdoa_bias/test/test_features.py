from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from random_samples import random_samples
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.correction.features import FEATURES, NAMES, PLACE, columns, everything
from uwb_tdoa_bias.effects import Samples

seeds = st.integers(0, 2**32 - 1)


def expected(samples):
    """Every feature by its name, each straight from its definition."""
    anchors, out = samples.anchors, {}
    for side, rows in (("a", samples.a), ("b", samples.b)):
        to_anchor = anchors.positions[rows] - samples.p
        for k, axis in enumerate("xyz"):
            out[f"d{axis}_{side}"] = to_anchor[:, k]
        seen_by_tag = Rotation.from_quat(samples.q).inv().apply(to_anchor)
        seen_by_anchor = Rotation.from_quat(anchors.orientations[rows]).inv().apply(-to_anchor)
        for viewer, direction in (("T", seen_by_tag), ("A", seen_by_anchor)):
            x, y, z = direction.T / np.linalg.norm(direction, axis=1)
            out[f"azimuth_{viewer}_{side}"] = np.arctan2(y, x)
            out[f"elevation_{viewer}_{side}"] = np.arcsin(z)
    return np.stack([out[name] for name in FEATURES], axis=1)


@given(seeds)
def test_places(seed):
    samples = random_samples(seed)
    body = Rotation.from_quat(samples.q).as_matrix()
    ends = [
        np.column_stack([samples.anchors.ids[k], samples.anchors.positions[k]])
        for k in (samples.a, samples.b)
    ]
    expected_place = np.concatenate([samples.p, body[:, :2, 0], body[:, :2, 2], *ends], axis=1)
    np.testing.assert_allclose(columns(samples, PLACE), expected_place, atol=1e-12)
    np.testing.assert_array_equal(columns(samples, NAMES[::-1]), everything(samples)[:, ::-1])


@given(seeds)
def test_definitions(seed):
    samples = random_samples(seed)
    # arcsin is steep near the pole
    np.testing.assert_allclose(columns(samples, FEATURES), expected(samples), atol=1e-6)


def test_a_case_worked_by_hand():
    quarter = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]  # 90 degrees about z: body x is world y
    anchors = Anchors([0, 1], [[3.0, 0.0, 4.0], [0.0, -2.0, 0.0]], [[0, 0, 0, 1], quarter])
    samples = Samples(
        np.zeros(1), np.array([0]), np.array([1]), np.zeros((1, 3)), np.array([quarter]), anchors
    )
    found = dict(zip(FEATURES, columns(samples, FEATURES)[0]))
    up = np.arctan2(4.0, 3.0)
    hand = {
        "dx_a": 3.0,
        "dy_a": 0.0,
        "dz_a": 4.0,
        "dx_b": 0.0,
        "dy_b": -2.0,
        "dz_b": 0.0,
        "azimuth_A_a": np.pi,
        "elevation_A_a": -up,  # anchor a sees the tag at (-3, 0, -4)
        "azimuth_A_b": 0.0,
        "elevation_A_b": 0.0,  # anchor b, whose x axis is world y, sees it ahead
        "azimuth_T_a": -np.pi / 2,
        "elevation_T_a": up,  # world x is to the right of the tag
        "azimuth_T_b": np.pi,
        "elevation_T_b": 0.0,
    }
    for name in FEATURES:
        apart = found[name] - hand[name]
        if name.startswith("azimuth"):
            apart = (apart + np.pi) % (2.0 * np.pi) - np.pi
        assert abs(apart) < 1e-12, name


def test_unknown_attitudes_make_only_their_own_angles_nan():
    samples = random_samples(3, n=4, n_anchors=2)
    orientations = samples.anchors.orientations.copy()
    orientations[0] = np.nan
    q = samples.q.copy()
    q[:2] = np.nan
    anchors = Anchors(samples.anchors.ids, samples.anchors.positions, orientations)
    unknown = Samples(
        samples.t, np.array([0, 1, 0, 1]), np.array([1, 0, 1, 0]), samples.p, q, anchors
    )
    found = columns(unknown, FEATURES)
    for i in range(4):
        for k, name in enumerate(FEATURES):
            row = unknown.a[i] if name.endswith("_a") else unknown.b[i]
            needs_tag, needs_anchor = "_T_" in name, "_A_" in name
            lost = (needs_tag and i < 2) or (needs_anchor and row == 0)
            assert np.isnan(found[i, k]) == lost, (i, name)
