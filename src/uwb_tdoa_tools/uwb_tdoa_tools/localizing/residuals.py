"""What is left of each TDOA and range after the estimate: a table, sums per pair of anchors or per
anchor, a picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.foundation.files import write_filled, write_text
from uwb_tdoa_bias.foundation.sensors import LOCATING
from uwb_tdoa_ekf.results import VERDICTS, Residuals, concatenated

from ..scoring.metrics import reached

if TYPE_CHECKING:
    from uwb_tdoa_bias.foundation.flight import Flight
    from uwb_tdoa_ekf.offline import Run

COLUMNS = "t", "a", "b", "residual", "std", "weight", "verdict"
SHOWN, FEWEST = (
    20,
    20,
)  # pairs in the picture at most, those with the most TDOAs; TDOAs of a pair that is shown at least
# robust standard deviations that the picture reaches; what is farther off is drawn at its edge
SPREAD = 6.0


@dataclass(frozen=True)
class OfPair:
    """Residuals of the TDOAs between two anchors, a before b, or of the ranges to one, which is
    both. t (n,) s; value, std (n,) m, of d_ab or of the range; explained (n,) bool, within three
    standard deviations.
    """

    a: int
    b: int
    t: np.ndarray
    value: np.ndarray
    std: np.ndarray
    explained: np.ndarray

    @property
    def name(self) -> str:
        """What it is called in pictures."""
        return f"{self.a} - {self.b}" if self.a != self.b else f"range {self.a}"

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "a": self.a,
            "b": self.b,
            "tdoas": len(self.t),
            "median": float(np.median(self.value)),
            "std": float(self.value.std()),
            "explained": float(self.explained.mean()),
        }


def of_run(flight: Flight, run: Run) -> Residuals:
    """Residuals of the TDOAs of a Run over a Flight, and of what else locates: of distances to
    anchors, of which a and b are the same.
    """
    parts = [run.residuals]
    for name in LOCATING:
        if name in run.aids:
            stream = getattr(flight, name)
            parts.append(
                Residuals.from_rows(stream.t, stream.anchor, stream.anchor, run.aids[name])
            )
    return concatenated(parts)


def explained(residuals: Residuals) -> np.ndarray:
    """Which TDOAs were within three of the standard deviations that the filter expected: (n,) bool."""
    with np.errstate(invalid="ignore"):  # NaN, of those without a residual, is not
        return reached(residuals) & (residuals.innovation**2 <= 9.0 * residuals.variance)


def by_pair(residuals: Residuals) -> list[OfPair]:
    """Residuals of each pair of anchors, in the order of their ids."""
    there, fits = reached(residuals), explained(residuals)
    low, high = np.minimum(residuals.a, residuals.b), np.maximum(residuals.a, residuals.b)
    sign = np.where(residuals.a <= residuals.b, 1.0, -1.0)
    pairs = []
    order = np.flatnonzero(there)[np.lexsort((high[there], low[there]))]
    begins = np.flatnonzero((np.diff(low[order]) != 0) | (np.diff(high[order]) != 0)) + 1
    for rows in np.split(order, begins) if len(order) else ():
        a, b = int(low[rows[0]]), int(high[rows[0]])
        value, std = (sign * residuals.innovation)[rows], np.sqrt(residuals.variance[rows])
        pairs.append(OfPair(a, b, residuals.t[rows], value, std, fits[rows]))
    return pairs


def write_csv(path: Path, residuals: Residuals) -> None:
    """Write a line for each TDOA: s, ids of the anchors, m, m, 0 to 1, and what became of it.

    Empty where the filter had no residual.
    """
    lines, std = [",".join(COLUMNS)], np.sqrt(residuals.variance)
    rows = zip(
        residuals.t,
        residuals.a,
        residuals.b,
        residuals.innovation,
        std,
        residuals.weight,
        residuals.verdict,
    )
    for t, a, b, value, its_std, weight, verdict in rows:
        numbers = f"{value:.4f},{its_std:.4f},{weight:.3f}" if np.isfinite(value) else ",,"
        lines.append(f"{t:.6f},{int(a)},{int(b)},{numbers},{VERDICTS[int(verdict)]}")
    write_text(path, "\n".join([*lines, ""]))


def picture(path: Path, residuals: Residuals, title: str) -> None:
    """Residuals of each pair over time, a row each, those that the estimate does not explain in
    red, with their median beside it.
    """
    from matplotlib.figure import Figure  # takes a second to import

    found = by_pair(residuals)
    pairs = sorted((one for one in found if len(one.t) >= FEWEST), key=lambda one: -len(one.t))[
        :SHOWN
    ]
    pairs = sorted(pairs, key=lambda one: (one.a, one.b))
    if not pairs:
        return
    figure = Figure(figsize=(11.0, 1.2 + 0.62 * len(pairs)), layout="constrained")
    axes = np.atleast_1d(figure.subplots(len(pairs), 1, sharex=True, sharey=True))
    begin = min(one.t[0] for one in pairs)
    limit = max(
        0.3,
        SPREAD * 1.4826 * float(np.median(np.abs(np.concatenate([one.value for one in pairs])))),
    )
    tick = np.floor(8.0 * limit) / 10.0  # m, whole tens of cm
    for ax, one in zip(axes, pairs):
        shown = np.clip(one.value, -limit, limit)
        ax.axhline(0.0, color="0.8", lw=0.8)
        ax.plot(one.t - begin, shown, ".", ms=2.0, color="tab:blue")
        ax.plot(
            (one.t - begin)[~one.explained], shown[~one.explained], ".", ms=3.0, color="tab:red"
        )
        ax.set(ylim=(-limit, limit), yticks=(-tick, 0.0, tick))
        ax.set_yticklabels([f"{-100 * tick:.0f}", "0", f"{100 * tick:.0f}"], fontsize=7)
        ax.set_ylabel(one.name, rotation=0, ha="right", va="center", fontsize=9)
        summary = f"{100 * np.median(one.value):+.0f} cm, {one.explained.mean():.0%} explained"
        ax.text(1.005, 0.5, summary, transform=ax.transAxes, fontsize=8, va="center")
    axes[-1].set_xlabel("time of the recording [s]")
    left_out = (
        f"; {len(found) - len(pairs)} pairs with fewer TDOAs are not shown"
        if len(pairs) < len(found)
        else ""
    )
    figure.suptitle(
        (
            f"{title}: residuals of each pair of anchors [cm]; red: more than three standard "
            f"deviations{left_out}"
        ),
        fontsize=10,
    )
    write_filled(path, partial(figure.savefig, dpi=110))
