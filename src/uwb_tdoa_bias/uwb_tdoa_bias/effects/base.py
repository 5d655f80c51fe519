"""What a systematic effect is."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ..anchors import Anchors
from ..errors import InputError


@dataclass(frozen=True)
class Samples:
    """A batch of TDOAs and the pose the tag had, or was believed to have, when they were taken.

    t : (n,) s; a, b : (n,) rows of `anchors`; p : (n, 3) m, world; q : (n, 4) x y z w, body to world, NaN if unknown.
    """

    t: np.ndarray
    a: np.ndarray
    b: np.ndarray
    p: np.ndarray
    q: np.ndarray
    anchors: Anchors

    def __len__(self):
        return len(self.t)


@dataclass
class Effect:
    """A named systematic error of a TDOA with scalar parameters. One effect, one file: subclass and list it in EFFECTS.

    values : {parameter name: value in `unit`}; std : the same keys, standard errors, empty if unknown;
    source : where the values came from, free text.
    """

    values: dict = field(default_factory=dict)
    std: dict = field(default_factory=dict)
    source: str = ""

    name: ClassVar[str]
    unit: ClassVar[str]
    bound: ClassVar[float]  # a larger magnitude is refused as a mistake, in `unit`
    confounded_with: ClassVar[tuple] = ()
    reference: ClassVar[str]

    def __post_init__(self):
        for group in ("values", "std"):
            read = {}
            for key, value in (getattr(self, group) or {}).items():
                key = str(key)
                self.check_key(key)
                try:
                    read[key] = float(value)
                except (TypeError, ValueError):
                    read[key] = np.nan
                if not np.isfinite(read[key]) or abs(read[key]) > self.bound:
                    raise InputError(
                        f"effects: {self.name}: {group}: {key} is {value!r}; expected a number of {self.unit} "
                        f"between -{self.bound:g} and {self.bound:g}."
                    )
            setattr(self, group, read)

    @classmethod
    def check_key(cls, key):
        """Raise InputError if `key` is no parameter of this effect."""
        raise NotImplementedError

    def bias(self, samples):
        """Contribution to the measured d_ab, (n,) metres; NaN where it cannot be told (unknown pose)."""
        raise NotImplementedError

    def regressors(self, samples, keys):
        """Derivative of `bias` with respect to the parameters named in `keys`, (n, len(keys)), metres per `unit`."""
        raise NotImplementedError
