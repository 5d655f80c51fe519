# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Model, an ONNX file that corrects TDOAs, and the statuses of a correction."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from ..common.errors import InputError
from ..common.files import read_bytes
from ..common.limits import MODEL_BYTES
from ..common.text import printable

if TYPE_CHECKING:
    import numpy as np

    from ..common.anchors import Anchors
    from ..effects.samples import Samples
    from .session import Session

# status of one correction; the values of TdoaCorrected.STATUS_*
PASSED, EFFECTS, NETWORK, FADED = range(4)
# Share of the possible knowledge; a prediction with less counts as faded.
FADED_BELOW = 0.5


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
    trained_with : names of the effects that were corrected before the training; they must be
        corrected in use, too
    holds : labels of the effects that the file itself corrects; nothing else may correct them
    of_effects : their names, joined by '+', or ""
    needs_motion : whether it depends on more than poses
    """

    NEEDS: ClassVar[str]  # what the metadata must hold, for messages
    name: str
    trained_with: tuple[str, ...] = ()
    holds: tuple[str, ...] = ()
    of_effects: str = ""
    needs_motion: bool = False

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

    def added(self, samples: Samples, known: Prediction) -> Prediction:
        """Return a Prediction of Samples with that of the model added."""
        raise NotImplementedError

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
    content = read_bytes(path, MODEL_BYTES)
    from .trial import Session, Unplayable, tried_out  # imports onnxruntime

    try:
        return Session(content, alone=tried_out(content))
    except Unplayable as error:
        raise InputError(
            f"model: {path} cannot be played as an ONNX model of dense layers "
            f"({printable(str(error))}); export it again, without what it names."
        ) from error
