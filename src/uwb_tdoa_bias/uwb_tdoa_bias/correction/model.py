# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Model, an ONNX file that corrects TDOAs, and the statuses of a correction."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from ..common.anchors import SAME_PLACE, Anchors
from ..common.errors import InputError
from ..common.files import read_bytes
from ..common.limits import MODEL_BYTES
from ..common.text import printable, sanitize
from ..effects.base import cached_by_anchors, counted
from ..effects.samples import N_STATES, Samples

if TYPE_CHECKING:
    from .session import Session


# status of one correction; the values of TdoaCorrected.STATUS_*
PASSED, EFFECTS, NETWORK, FADED = range(4)
# Share of the possible knowledge; a prediction with less counts as faded.
FADED_BELOW = 0.5
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
