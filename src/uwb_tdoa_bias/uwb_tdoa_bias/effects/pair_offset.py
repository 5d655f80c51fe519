"""An error of the link between two anchors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..foundation.errors import InputError
from .base import Effect
from .wording import listed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from ..foundation.anchors import Anchors
    from .samples import Samples


class PairOffset(Effect):
    """d_ab of the ordered pair "a-b" is `values["a-b"]` metres too large, and d_ba as much too
    small.
    """

    name = "pair_offset"
    unit = "m"
    bound = 5.0
    negligible = 0.01
    typical = 0.3
    example = "0-1"
    physics = (
        "the tag subtracts the time of flight that two anchors measured between them; its "
        "error is a "
        "constant of the pair"
    )
    confounded_with = ("anchor_delay", "anchor_position")
    reference = "Bitcraze documentation of TDoA2: anchor-to-anchor time of flight"
    portable = False

    @classmethod
    def check_key(cls, key: str) -> None:
        check_pair(cls.name, key)

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        keys = link_keys(pairs)
        return [keys, *((key,) for key in keys)]

    def bias(self, samples: Samples) -> np.ndarray:
        table: dict[tuple[int, int], float] = {}
        for key, value in self.values.items():
            a, b = map(int, key.split("-"))
            table[a, b] = table.get((a, b), 0.0) + value
            table[b, a] = table.get((b, a), 0.0) - value
        offsets = np.zeros((len(samples.anchors),) * 2)
        rows = {i: row for row, i in enumerate(samples.anchors.ids.tolist())}
        for (a, b), value in table.items():
            if a in rows and b in rows:
                offsets[rows[a], rows[b]] = value
        return offsets[samples.a, samples.b]

    def regressors(self, samples: Samples, keys: Sequence[str]) -> np.ndarray:
        a, b = samples.anchors.ids[samples.a], samples.anchors.ids[samples.b]
        links = [tuple(map(int, key.split("-"))) for key in keys]
        return np.stack(
            [1.0 * ((a == i) & (b == k)) - ((a == k) & (b == i)) for i, k in links], axis=1
        )

    def advice(self) -> tuple[str, ...]:
        off = [
            f"the TDOA of {key} is {self.size(key)} too {'large' if value > 0.0 else 'small'}"
            for key, value in self.significant().items()
        ]
        if not off:
            return ()
        links = listed(f"{key.replace('-', ' and ')}" for key in self.significant())
        return (
            f"Let anchors {links} measure the time of flight between them again: {listed(off)}.",
        )


def check_pair(name: str, key: str) -> None:
    """Raise InputError for a key of the effect of a name that is no pair of anchors, "a-b"."""
    if len(key.split("-")) != 2 or not all(part.isdigit() for part in key.split("-")):
        raise InputError(
            f"effects: {name}: parameter {key!r} is not a pair of anchors; write for example '0-1'."
        )


def link_keys(pairs: ArrayLike | None) -> tuple[str, ...]:
    """Names of the links that were heard, each once, in the direction that was heard more or first."""
    keys: list[str] = []
    for a, b in [] if pairs is None else np.asarray(pairs).tolist():
        if f"{b}-{a}" not in keys and f"{a}-{b}" not in keys:
            keys.append(f"{a}-{b}")
    return tuple(keys)
