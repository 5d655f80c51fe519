# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A bias network in an ONNX file with its own inputs, limits and validity.

Metadata of the model (all values JSON text):
    features  list of names out of features.FEATURES and features.ATTITUDE: the input columns
    offset, scale  lists as long as features: the network input is (feature - offset) / scale
    clip      number, metres: the output is limited to +-clip
    name      short name, goes into every message
    validity  optional: {feature: [lowest, highest, margin]}, in the units of the features. Inside, the output
              counts fully; beyond by `margin` or more, not at all; linearly in between, the worst
              feature counting.
    fade_std  number, metres, with validity: standard deviation of the bias where the output does not count
    largest_yaw_std  optional: number, radians; where the yaw is less certain, the bias is not corrected, but counts
              as uncertainty
    share     optional: number 0 ... 1: share of the prediction that is corrected, found by cross-validation over the
              flights of the training; the rest counts as uncertainty
Input: one float tensor (n, number of features), of any name. Output: one float tensor. (n, 1): bias
in metres. (n, 2): bias and its standard deviation in metres.
"""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..common.arrays import filled, floats
from ..common.compiled import compiled
from ..common.errors import InputError
from ..common.text import sanitize
from .features import NAMES, everything
from .model import FADED, FADED_BELOW, NETWORK, ExportedCorrection, Model, Prediction, session_of

if TYPE_CHECKING:
    from pathlib import Path

    from ..effects.samples import Samples
    from .session import Session

NO_NUMBERS = np.empty(0)
_COLUMN = {name: column for column, name in enumerate(NAMES)}


def load_network(name: str | Path | None) -> Model | None:
    """Return the Model of a file, or None for an empty name; raise InputError."""
    if not name:
        return None
    session = session_of(name)
    kind = ExportedCorrection if "kind" in session.meta and "inputs" in session.meta else Network
    return kind(name, session)


class Validity(NamedTuple):
    """The ranges of the features outside of which a network fades.

    Attributes
    ----------
    columns : (k,) of NAMES
    lower, upper : (k,), full validity between them
    margin : (k,), distance from this range to no validity; units of the features
    """

    columns: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    margin: np.ndarray


class Network(Model):
    """An ONNX bias model of some features.

    Attributes
    ----------
    share : share of its prediction that is corrected, 0 ... 1
    """

    NEEDS = (
        f"features (names out of {', '.join(NAMES)}), offset, scale, clip and name, and may hold "
        "validity with fade_std, as JSON"
    )

    def __init__(self, path: str | Path, session: Session | None = None) -> None:
        """Load a file as Model does, and run it on the mean of all features."""
        super().__init__(path, session)
        width, n = self._model.width, len(self._inputs)
        if not (n == len(self._offset) == len(self._scale) == width) or (self._scale == 0).any():
            raise InputError(
                f"model: {path}: the input has {width} columns, the metadata name {n} features, "
                f"{len(self._offset)} offsets and {len(self._scale)} scales; they must agree, "
                "and no scale may be 0."
            )
        out = self._model.run(np.zeros((1, n)))
        if out.shape[1] > 2 or not np.isfinite(out).all():
            raise InputError(
                f"model: {path}: gives (n, {out.shape[1]}), or no finite numbers; the output "
                "must be (n, 1) or (n, 2)."
            )

    def _read(self, meta: dict[str, str]) -> None:
        names = json.loads(meta["features"])
        self._offset = np.array(json.loads(meta["offset"]), dtype=float)
        self._scale = np.array(json.loads(meta["scale"]), dtype=float)
        self.clip = float(json.loads(meta["clip"]))
        self.name = sanitize(json.loads(meta["name"]))
        limits = json.loads(meta.get("validity", "{}"))
        self._fade_std = float(json.loads(meta["fade_std"])) if limits else 0.0
        self._largest_yaw_std = float(json.loads(meta.get("largest_yaw_std", "Infinity")))
        self.share = float(json.loads(meta.get("share", "1.0")))
        self._inputs = np.array([_COLUMN[name] for name in names], dtype=int)
        self.uses_orientations = any("_A_" in name for name in names)
        limited = np.array([_COLUMN[name] for name in limits], dtype=int)
        lower, upper, margin = np.array([*limits.values()], dtype=float).reshape(-1, 3).T
        self._validity = Validity(limited, lower, upper, margin)
        if not ((margin > 0.0) & (upper >= lower)).all():
            raise ValueError("validity: every feature needs [lowest, highest, margin above 0]")
        if not all(np.isfinite(values).all() for values in (self._offset, self._scale, margin)):
            raise ValueError("offset, scale and margins must be finite numbers")
        if not (
            self.clip > 0.0 and 0.0 <= self._fade_std < np.inf and self._largest_yaw_std >= 0.0
        ):
            raise ValueError("clip must be above 0, fade_std and largest_yaw_std not below")
        if not 0.0 <= self.share <= 1.0:
            raise ValueError("share must be between 0 and 1")

    def added(self, samples: Samples, known: Prediction) -> Prediction:
        shape, learned = (len(samples), 3), self.predict(samples)
        bias, std, status = filled(_add, shape, *learned, *known[:3]).T
        return Prediction(bias, std, status, *known[3:])

    def predict(self, samples: Samples) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return bias (n,) m, its std (n,) m, and the share (n,) 0 ... 1 of the possible knowledge.

        Bias and std are NaN where a required feature is unknown.
        """
        yaw_std = NO_NUMBERS if samples.yaw_std is None else floats(samples.yaw_std)
        limits = self.clip, self._fade_std, self.share, self._largest_yaw_std
        table = everything(samples)
        out = self._model.run((table[:, self._inputs] - self._offset) / self._scale)
        bias, std, known = filled(
            _limit, (len(samples), 3), out, table, self._validity, limits, yaw_std
        ).T
        return bias, std, known


@compiled
def _limit(
    out: np.ndarray,
    table: np.ndarray,
    validity: Validity,
    limits: tuple[float, float, float, float],
    yaw_std: np.ndarray,
    found: np.ndarray,
) -> None:
    """Write bias, m, std, m, and known share, (n, 3), to found; compiled.

    out : (n, 1 or 2), output of the network; table : (n, 18), as of `everything`
    limits : clip, m, fade_std, m, share, largest_yaw_std, rad; yaw_std : (n,) rad, or empty
    """
    columns, lower, upper, margin = (
        validity.columns,
        validity.lower,
        validity.upper,
        validity.margin,
    )
    clip, fade_std, share, largest_yaw_std = limits[0], limits[1], limits[2], limits[3]
    for i in range(len(out)):
        bias, std, known = out[i, 0], 0.0, 1.0
        if abs(bias) > clip:
            bias = math.copysign(clip, bias)
        if out.shape[1] > 1:
            std = out[i, 1]
        if len(columns):
            beyond = 0.0
            for k in range(len(columns)):
                value = table[i, columns[k]]
                far = np.maximum(lower[k] - value, value - upper[k]) / margin[k]
                beyond = np.maximum(far, beyond)  # NaN of an unknown value
            trust = 1.0 - np.minimum(beyond, 1.0)
            bias, known = trust * bias, trust * known
            std = math.sqrt((trust * std) ** 2 + (1.0 - trust**2) * fade_std**2)
        if share < 1.0:
            std, bias = math.hypot(std, (1.0 - share) * bias), share * bias
        if len(yaw_std) and yaw_std[i] > largest_yaw_std:
            std = math.hypot(std, bias)
            bias = known = 0.0
        found[i, 0], found[i, 1], found[i, 2] = bias, std, known


@compiled
def _add(
    learned: np.ndarray,
    deviation: np.ndarray,
    known: np.ndarray,
    bias: np.ndarray,
    std: np.ndarray,
    status: np.ndarray,
    out: np.ndarray,
) -> None:
    """Write bias, m, std, m, and status of effects and network to out, (n, 3); compiled.

    learned, deviation : (n,) m, bias and std of the network; a row whose bias is NaN (a feature is
    unknown) keeps the values of the effects
    known : (n,) 0 ... 1, share of the possible knowledge; below FADED_BELOW the status is FADED
    bias, std, status : (n,), of the effects alone
    """
    for i in range(len(bias)):
        out[i, 0], out[i, 1], out[i, 2] = bias[i], std[i], status[i]
        if math.isfinite(learned[i]):
            out[i, 0] += learned[i]
            if math.isfinite(deviation[i]):
                out[i, 1] = math.hypot(std[i], deviation[i])
            out[i, 2] = FADED if known[i] < FADED_BELOW else NETWORK
