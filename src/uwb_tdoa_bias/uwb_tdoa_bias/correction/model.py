# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Model, an ONNX file that corrects TDOAs: a whole correction, or a bias network with its features, limits and validity.

The features are the 14 inputs of Zhao et al. (RA-L 2021, section III), and the attitude, which limits their use.

Metadata of a network (all values JSON text):
    features  list of names out of FEATURES and ATTITUDE: the input columns
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
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from ..common.anchors import SAME_PLACE, Anchors
from ..common.arrays import filled, floats
from ..common.compiled import compiled
from ..common.errors import MODEL_BYTES, InputError, printable, sanitize
from ..common.files import read_bytes
from ..common.geometry import rotate
from ..effects.base import FADED_BELOW, cached_by_anchors, counted
from ..effects.samples import N_STATES, Samples

if TYPE_CHECKING:
    from collections.abc import Iterable

    from .session import Session


# status of one correction; the values of TdoaCorrected.STATUS_*
PASSED, EFFECTS, NETWORK, FADED = range(4)
# m. A file that adds more is broken: the largest measured bias is 4 m.
LARGEST_ADDED = 100.0


class Prediction(NamedTuple):
    """The bias of n TDOAs, in the units of a Correction.

    bias, std, status : (n,); slope, state : (n, 6)
    """

    bias: np.ndarray
    std: np.ndarray
    status: np.ndarray
    slope: np.ndarray
    state: np.ndarray


class Model:
    """An ONNX file that corrects TDOAs: a Network or an ExportedCorrection.

    Attributes
    ----------
    meta : all its metadata, dict of str
    name : name in messages
    holds : labels of the effects that the file itself corrects; nothing else may correct them
    of_effects : their names, joined by '+', or ""
    needs_motion : whether it depends on more than poses
    uses_orientations : whether it reads the orientations of anchors
    """

    NEEDS: ClassVar[str]  # what the metadata must hold, for messages
    name: str
    holds: tuple[str, ...] = ()
    of_effects: str = ""
    needs_motion: bool = False
    uses_orientations: bool = False

    def __init__(self, path: str | Path, session: Session | None = None) -> None:
        """Load a file; raise InputError if it is no model or has unsuitable metadata.

        session : of the file, if it is loaded already
        """
        self._path = Path(path).absolute()
        self._model = session or session_of(path)
        self.meta = self._model.meta
        try:
            self._read(self.meta)
        except (
            KeyError,
            ValueError,
            TypeError,
            AttributeError,
            OverflowError,
            RecursionError,
        ) as error:
            raise InputError(
                f"model: {path}: its metadata must hold {self.NEEDS}; the problem is {error!r}."
            ) from error

    def __reduce__(self) -> tuple[type[Model], tuple[Path]]:
        """Return the path of the file for pickle, which cannot store a session."""
        return type(self), (self._path,)

    def _read(self, meta: dict[str, str]) -> None:
        """Read the metadata; raise an exception if they are unsuitable."""
        raise NotImplementedError

    @property
    def statuses(self) -> tuple[int, ...]:
        """Return the statuses of TDOAs that it corrects."""
        return (EFFECTS,) if self.name == self.of_effects else (NETWORK, FADED)

    def added(self, samples: Samples, known: Prediction) -> Prediction:
        """Return a Prediction of Samples with that of the model added."""
        raise NotImplementedError

    def possibly_added(self, samples: Samples, known: Prediction) -> Prediction:
        """Return the same; impossible or infinite biases are left out."""
        out = self.added(samples, known)
        possible = np.abs(out.bias - known.bias) <= LARGEST_ADDED
        if possible.all():
            return out
        pairs = zip(out, known)
        return Prediction(*(np.where(possible, one.T, other.T).T for one, other in pairs))

    def trouble(self, anchors: Anchors) -> str | None:
        """Return a predicate of the file if it was not made for some Anchors, or None."""
        return None

    def require(self, anchors: Anchors) -> None:
        """Raise InputError if the model was not made for all Anchors."""
        trouble = self.trouble(anchors)
        if trouble:
            raise InputError(f"model: {self._path} {trouble}.")


def session_of(path: str | Path) -> Session:
    """Return the Session of a file whose content passed its trial; raise InputError."""
    if not Path(path).is_file():
        raise InputError(
            f"model: {path} does not exist; give an .onnx file or leave the model empty."
        )
    content = read_bytes(path, MODEL_BYTES, "model, an .onnx file")
    from .trial import Session, Unplayable, tried_out

    try:
        return Session(content, alone=tried_out(content))
    except Unplayable as error:
        raise InputError(
            f"model: {path} cannot be played as an ONNX model of dense layers "
            f"({printable(str(error))}); export it again, without what it names."
        ) from error


KIND = "correction"  # in the metadata
INPUTS = (
    ("anchor_a", "id", "first anchor; an unknown id gives the output 0"),
    ("anchor_b", "id", "second anchor, d_ab = |p - b| - |p - a|"),
    ("x", "m", "position of the tag, world; NaN if unknown, as all that follows"),
    ("y", "m", ""),
    ("z", "m", ""),
    ("qx", "1", "attitude of the tag, quaternion, body to world"),
    ("qy", "1", ""),
    ("qz", "1", ""),
    ("qw", "1", ""),
    ("vx", "m/s", "velocity of the tag, world"),
    ("vy", "m/s", ""),
    ("vz", "m/s", ""),
    ("ax", "m/s^2", "acceleration of the tag over the last 0.2 s, world, without gravity"),
    ("ay", "m/s^2", ""),
    ("az", "m/s^2", ""),
    ("wx", "rad/s", "angular rate of the tag over the last 0.2 s, body"),
    ("wy", "rad/s", ""),
    ("wz", "rad/s", ""),
    ("time", "s", "since the first TDOA"),
    ("interval", "s", "since the TDOA before"),
    ("previous_anchor", "id", "second anchor of the TDOA before"),
    ("yaw_std", "rad", "standard deviation of the yaw; above 1 rad the yaw is unknown"),
)
OUTPUTS = (
    ("bias", "m", "to subtract from d_ab"),
    ("std", "m", "of the error that remains: its square adds to the variance of d_ab"),
    ("slope_x", "1", "change of the bias with the position of the tag"),
    ("slope_y", "1", ""),
    ("slope_z", "1", ""),
    ("slope_vx", "s", "change of the bias with the velocity of the tag"),
    ("slope_vy", "s", ""),
    ("slope_vz", "s", ""),
    (
        "status",
        "1",
        "0 unknown anchors or infinite numbers, 1 effects, 2 with network, 3 network faded",
    ),
)
UNKNOWN = -1  # id of no anchor


class ExportedCorrection(Model):
    """A whole correction in one ONNX file, as `export` writes it: effects and network in one graph.

    The graph has one input table (n, 22), with the columns INPUTS, and one output table (n, 9), with
    the columns OUTPUTS, both of single precision. Metadata of the file (all values JSON text):
        kind      KIND
        name      names of effects and network, joined by +; goes into every message
        inputs, outputs  [name, unit, meaning] of each column
        frame     name of the world frame
        anchor_ids, anchor_positions  of the anchors that the constants of the graph belong to, m
        effects   labels of the effects in the graph
        of_effects  their names, joined by +
        needs_motion  whether the columns from vx to previous_anchor count
        has_slope  whether a slope is other than 0
        sources, network, left_out, written_by  what it was made of, and what it does not hold

    Attributes
    ----------
    anchors : Anchors that it was made for
    """

    NEEDS = (
        "name, effects, of_effects, needs_motion, has_slope, anchor_ids, anchor_positions and frame, as export "
        "writes them"
    )

    def _read(self, meta: dict[str, str]) -> None:
        self.name = sanitize(json.loads(meta["name"]))
        self.of_effects = sanitize(json.loads(meta["of_effects"]))
        self.holds = tuple(map(sanitize, json.loads(meta["effects"])))
        self.needs_motion = bool(json.loads(meta["needs_motion"]))
        self._has_slope = bool(json.loads(meta["has_slope"]))
        ids, positions = (json.loads(meta[f"anchor_{part}"]) for part in ("ids", "positions"))
        self.anchors = Anchors.from_positions(positions, ids, str(json.loads(meta["frame"])))
        if (self._model.width, self._model.outputs) != (len(INPUTS), len(OUTPUTS)):
            raise ValueError(f"the graph needs {len(INPUTS)} inputs and {len(OUTPUTS)} outputs")

    def added(self, samples: Samples, known: Prediction) -> Prediction:
        out = self._model.run(self._table(samples))
        return Prediction(
            known.bias + out[:, 0],
            np.hypot(known.std, out[:, 1]),
            np.maximum(known.status, out[:, -1]),
            known.slope + out[:, 2 : 2 + N_STATES],
            samples.linearization_point if self._has_slope else known.state,
        )

    def trouble(self, anchors: Anchors) -> str | None:
        missing = anchors.ids[self._ids(anchors) == UNKNOWN].tolist()
        if not missing:
            return None
        words = counted(map(str, missing), "anchor")
        return (
            f"was exported without {words}, or for another place: these TDOAs are not "
            "corrected; run export again with this survey"
        )

    def _table(self, samples: Samples) -> np.ndarray:
        """Return the input table of a batch, (n, 22)."""
        n, ids = len(samples), self._ids(samples.anchors)
        out = np.full((n, len(INPUTS)), np.nan)
        out[:, 0], out[:, 1] = ids[samples.a], ids[samples.b]
        out[:, 2:5], out[:, 5:9] = samples.p, samples.q
        if samples.motion is not None:
            out[:, 9:18] = np.hstack([*vars(samples.motion).values()])
        out[:, 18] = samples.t - samples.start
        if samples.interval is not None:
            out[:, 19], out[:, 20] = samples.interval, samples.previous
        out[:, 21] = 0.0 if samples.yaw_std is None else samples.yaw_std
        return out

    @cached_by_anchors
    def _ids(self, anchors: Anchors) -> np.ndarray:
        """Return the ids of Anchors, (N,), UNKNOWN for those that stand elsewhere."""
        rows = self.anchors.index(anchors.ids)
        moved = np.linalg.norm(self.anchors.positions[rows] - anchors.positions, axis=1)
        return np.where((rows >= 0) & (moved < SAME_PLACE), anchors.ids, UNKNOWN)


# d*: position of both anchors relative to the tag, m, world axes. Azimuth (about z, from x) and
# elevation (above the xy plane), rad. A: of the tag in the antenna frame of each anchor. T: of each
# anchor in the tag's body frame.
FEATURES = (
    "dx_a",
    "dy_a",
    "dz_a",
    "dx_b",
    "dy_b",
    "dz_b",
    "azimuth_A_a",
    "azimuth_A_b",
    "azimuth_T_a",
    "azimuth_T_b",
    "elevation_A_a",
    "elevation_A_b",
    "elevation_T_a",
    "elevation_T_b",
)

ATTITUDE = "forward_x", "forward_y", "up_x", "up_y"  # horizontal parts of the body's x and z axes
NAMES = FEATURES + ATTITUDE


def columns(samples: Samples, names: Iterable[str]) -> np.ndarray:
    """Return some features of a batch, (n, len(names)) float; NaN where unknown.

    names : out of NAMES
    """
    return everything(samples)[:, [NAMES.index(name) for name in names]]


def everything(samples: Samples) -> np.ndarray:
    """Return all features of a batch, (n, 18) float, in the order of NAMES.

    They are NaN where they need an unknown pose.
    """
    n, anchors = len(samples), samples.anchors
    ends = samples.p, samples.q, samples.a, samples.b
    return filled(_fill, (n, len(NAMES)), *ends, anchors.positions, anchors.orientations)


@compiled
def _fill(
    p: np.ndarray,
    q: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    positions: np.ndarray,
    orientations: np.ndarray,
    out: np.ndarray,
) -> None:
    delta = np.empty(3)
    inverse = np.empty(4)
    seen = np.empty(3)
    for i in range(len(a)):
        for side in range(2):
            anchor = a[i] if side == 0 else b[i]
            for k in range(3):
                delta[k] = positions[anchor, k] - p[i, k]
                out[i, 3 * side + k] = delta[k]
            _conjugate(q[i], inverse)
            rotate(inverse, delta, seen)
            out[i, 8 + side] = math.atan2(seen[1], seen[0])
            out[i, 12 + side] = math.atan2(seen[2], math.hypot(seen[0], seen[1]))
            for k in range(3):
                delta[k] = -delta[k]
            _conjugate(orientations[anchor], inverse)
            rotate(inverse, delta, seen)
            out[i, 6 + side] = math.atan2(seen[1], seen[0])
            out[i, 10 + side] = math.atan2(seen[2], math.hypot(seen[0], seen[1]))
        x, y, z, w = q[i]
        out[i, 14], out[i, 15] = 1 - 2 * (y * y + z * z), 2 * (x * y + z * w)
        out[i, 16], out[i, 17] = 2 * (x * z + y * w), 2 * (y * z - x * w)


@compiled
def _conjugate(q: np.ndarray, out: np.ndarray) -> None:
    out[0], out[1], out[2], out[3] = -q[0], -q[1], -q[2], q[3]


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
