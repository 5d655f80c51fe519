# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Two-way ranging: distances to anchors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..anchors import Anchors
from .sensor import Compared, Mistake, Sensor, Stream, finite, parameter

FARTHEST = 1000.0  # m
BEYOND = 5.0  # largest median distance, multiples of the anchors' extent
MOST, SOME = 0.5, 0.01  # share of impossible distances: error, and warning
MOST_NAMED = 8  # anchors in a sentence


@dataclass(frozen=True)
class Ranges(Stream):
    """Distances to anchors by two-way ranging.

    Attributes
    ----------
    t : (n,) s
    anchor : (n,) ids
    d : (n,) m
    variance : (n,) m^2, of the noise as the tag reports it; 0 where it reports none
    """

    t: np.ndarray
    anchor: np.ndarray
    d: np.ndarray
    variance: np.ndarray

    @property
    def values(self) -> np.ndarray:
        return self.d[:, None]

    def with_values(self, values: np.ndarray) -> Ranges:
        return replace(self, d=values[:, 0])


def _measured(ranges: Ranges) -> tuple[dict, np.ndarray]:
    rows = {
        "anchor": ranges.anchor,
        "value": ranges.d[:, None],
        "std": np.sqrt(np.maximum(ranges.variance, 0.0))[:, None],
    }
    return rows, (ranges.d >= 0.0) & (ranges.d < FARTHEST) & (ranges.variance >= 0.0) & np.isfinite(
        ranges.variance
    )


def _simulated(config: Any, room: Any, motion: Any, turn: Any, noise: Any) -> tuple:
    """Return ids, distances, m, and variances, m^2, (n,) each; the anchors take turns."""
    row = np.arange(len(motion.p)) % len(config.anchors)
    antenna = motion.p + turn.apply(config.tag_lever_arm)
    d = (
        np.linalg.norm(antenna - config.anchors.positions[row], axis=1)
        + config.range_noise * noise()
    )
    return config.anchors.ids[row], np.maximum(d, 0.0), np.zeros(len(d))


def _unknown(ranges: Ranges, anchors: Anchors) -> Mistake | None:
    """Return a Mistake if ids are missing in the survey, else None."""
    share = np.mean(~np.isin(ranges.anchor, anchors.ids))
    if share > 0.0:
        strange = np.setdiff1d(ranges.anchor, anchors.ids)
        heard, known = (
            ", ".join(map(str, ids)) for ids in (strange[:MOST_NAMED], anchors.ids[:MOST_NAMED])
        )
        evidence = (
            f"{100.0 * share:.0f} % of the ranges are to {heard}; the survey begins with {known}"
        )
        remedy = "--survey FILE  # with all anchors, under the ids that the tag reports"
        return (
            "range_unknown",
            "error",
            "ranges are to anchors that the survey does not list",
            evidence,
            remedy,
            float(share),
        )
    return None


def _unit(ranges: Ranges, anchors: Anchors) -> Mistake | None:
    """Return a Mistake if the unit is not metres, else None."""
    extent = float(np.linalg.norm(np.ptp(anchors.positions, axis=0)))
    middle = float(np.median(ranges.d))
    if middle > BEYOND * extent or middle < 0.001 * extent:
        evidence = (
            f"their median is {middle:.4g} m, and the anchors are {extent:.1f} m apart at most"
        )
        remedy = "publish metres: divide millimetres by 1000, multiply seconds by 299792458"
        return (
            "range_unit",
            "error",
            "ranges are in another unit than metres",
            evidence,
            remedy,
            middle,
        )
    return None


def _impossible(ranges: Ranges, anchors: Anchors) -> Mistake | None:
    """Return a Mistake if more than the share SOME of the values cannot be distances, else None."""
    share = float(np.mean(~_measured(ranges)[1] | (ranges.d == 0.0)))
    if share > SOME:
        evidence = (
            f"{100.0 * share:.1f} % of the ranges are 0 or less, no numbers, or more than "
            f"{FARTHEST:g} m"
        )
        severity, cause = (
            ("error", "most ranges cannot be distances")
            if share > MOST
            else ("warning", "some ranges cannot be distances: they are lost")
        )
        remedy = "publish |p - a| in metres, and nothing where the exchange has failed"
        return "range_invalid", severity, cause, evidence, remedy, share
    return None


SENSOR = Sensor(
    name="range",
    plural="ranges",
    stream=Ranges,
    message="uwb_tdoa_msgs/msg/AnchorRange",
    fields={"anchor": 1, "distance": 1, "variance": 1},
    columns=lambda fields: (
        np.asarray(fields["anchor"]).astype(np.int64),
        fields["distance"],
        fields["variance"],
    ),
    content=lambda ranges: {
        "anchor": ranges.anchor,
        "distance": ranges.d,
        "variance": ranges.variance,
    },
    sound=finite,
    measured=_measured,
    simulated=_simulated,
    noise=("M", "write distances to anchors, as of two-way ranging", 0.1),
    parameters={
        "use_range": parameter(
            True, "use distances to anchors, as of two-way ranging, if there are any", fixed=True
        ),
        "range_std": parameter(
            0.1, "m; of a distance to an anchor, uncorrected systematic part included", high=100.0
        ),
        "range_offset_std": parameter(
            0.3,
            (
                "m; standard deviation of the offset common to all ranges, which the filter "
                "finds; 0.0: there is none"
            ),
            high=100.0,
            with_low=True,
        ),
    },
    invalid="give ids of uwb/anchors, and distances in metres, 0 or more",
    remedy="its unit, and the anchors' positions",
    compared=Compared(
        None,
        "ranges, and ground truth of the position",
        negligible=0.004,
        of_attitude=False,
        positions=(0, 1, 2),
    ),
    topic="uwb/range",
    rate=100.0,
    locates=True,
    rules=(_unknown, _unit, _impossible),
)
