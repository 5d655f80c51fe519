# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where a tag stayed: visits to named areas, and places where it was parked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from uwb_tdoa_bias.common.arrays import numbers_of
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import write_picture, write_text
from uwb_tdoa_bias.common.safe_yaml import read_yaml
from uwb_tdoa_ekf.results import Odometry

PARKED = "parked"
LEAST = 0.2  # m beyond the edge of an area at which a tag enters or leaves it, or its deviation
# s, and m about the mean position, or the circle of 95 %: a tag that stays there is parked
LONG, NEAR = 60.0, 0.5
UNSURE = 1.0  # m, circle of 95 % above which it is not known to be parked
PERIOD = 0.2  # s between the estimates of a track

Areas = Mapping[str, np.ndarray]  # {name: (k, 2) corners, m}


@dataclass(frozen=True)
class Stay:
    """A visit to an area, or the time of a parked tag.

    Attributes
    ----------
    area : name, or PARKED.
    begin, end, seconds : s.
    x, y : mean position, m.
    """

    area: str
    begin: float
    end: float
    seconds: float
    x: float
    y: float


@dataclass(frozen=True)
class Track:
    """Path of a tag from above.

    Attributes
    ----------
    t : (n,) s.
    p : (n, 2) m.
    std, circle : (n,) m, standard deviation, and radius of 95 %.
    """

    t: np.ndarray
    p: np.ndarray
    std: np.ndarray
    circle: np.ndarray


def circle_of(covariance: np.ndarray) -> np.ndarray:
    """Return the radii (n,), m, of circles about the position that hold the tag for 95 % of the time.

    covariance : (n, k, k), its first two rows x and y. The sum of two squares is approximated by a
    scaled chi-squared variable of the same mean and variance (Satterthwaite, Biometrics 1946); the
    radius is exact for a circle and for a line, and within 0.5 % else.
    """
    plane = covariance[:, :2, :2]
    trace, square = np.einsum("nii->n", plane), np.einsum("nij,nji->n", plane, plane)
    scale = square / np.maximum(trace, 1e-12)
    return np.sqrt(scale * chi2.ppf(0.95, trace / np.maximum(scale, 1e-12)))


def track_of(odometry: Odometry) -> Track:
    """Return the Track of an Odometry, with one estimate in each PERIOD."""
    rows = np.unique(np.floor(odometry.t / PERIOD), return_index=True)[1]
    covariance = odometry.covariance[rows]
    std = np.sqrt(np.einsum("nii->n", covariance[:, :2, :2]))
    return Track(odometry.t[rows], odometry.p[rows, :2], std, circle_of(covariance))


def read_areas(path: str | Path) -> Areas:
    """Return the areas of a YAML file {name: [[x, y], ...]}; m, world frame. Raise InputError."""
    content = read_yaml(path)
    if not isinstance(content, dict) or not content:
        raise InputError(f"{path}: no areas; write name: [[x, y], [x, y], [x, y]], in metres.")
    areas = {}
    for name, corners in content.items():
        one = areas[str(name)] = numbers_of(corners)
        if str(name) == PARKED:
            raise InputError(f"{path}: {name}: parked tags have this name; give the area another.")
        if one.ndim != 2 or one.shape[1] != 2 or len(one) < 3:
            raise InputError(
                f"{path}: {name}: an area is a list of three or more corners [x, y] in metres, "
                f"not {corners!r}."
            )
    return areas


def depth(corners: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return how far positions p (n, 2) are inside a polygon (k, 2), m; negative outside."""
    from matplotlib.path import Path as Polygon  # takes a second to import

    along = np.roll(corners, -1, axis=0) - corners
    off = p[:, None] - corners
    share = np.einsum("nkj,kj->nk", off, along) / np.maximum(np.sum(along**2, axis=1), 1e-12)
    nearest = off - np.clip(share, 0.0, 1.0)[:, :, None] * along
    edge = np.linalg.norm(nearest, axis=2).min(axis=1, initial=np.inf)
    return np.where(Polygon(corners).contains_points(p), edge, -edge)


def visits(track: Track, areas: Areas) -> Iterator[Stay]:
    """Yield the visits to each area.

    A tag enters or leaves when it is beyond the edge by LEAST, or by its standard deviation where that
    is larger: an uncertain tag changes nothing. Until it is certain, it counts as outside.
    """
    for name, corners in areas.items() if len(track.t) else ():
        inside = depth(corners, track.p)
        sure = np.abs(inside) > np.maximum(LEAST, track.std)
        last = np.maximum.accumulate(np.where(sure, np.arange(len(sure)), 0))
        there = np.concatenate([[False], sure[last] & (inside[last] > 0.0), [False]])
        edges = np.flatnonzero(there[1:] != there[:-1])
        for first, end in zip(edges[::2].tolist(), edges[1::2].tolist()):
            yield _stay(name, track, first, end)


def parked(track: Track) -> Iterator[Stay]:
    """Yield the times at which the tag stayed at a place for LONG."""
    first, n = 0, len(track.t)
    reach = np.where(track.circle > UNSURE, -1.0, np.maximum(NEAR, track.circle))
    while first < n:
        end, mean = first + 1, track.p[first]
        while end < n and np.linalg.norm(track.p[end] - mean) <= reach[end]:
            end += 1
            mean = mean + (track.p[end - 1] - mean) / (end - first)
        if track.t[end - 1] - track.t[first] >= LONG:
            yield _stay(PARKED, track, first, end)
        first = end


def _stay(area: str, track: Track, first: int, end: int) -> Stay:
    """Return the Stay of rows first to end, which it does not contain."""
    begin, until = float(track.t[first]), float(track.t[min(end, len(track.t) - 1)])
    x, y = track.p[first:end].mean(axis=0).tolist()
    return Stay(area, begin, until, until - begin, x, y)


def write_stays(path: Path, stays: Sequence[Stay]) -> None:
    """Write one CSV line per Stay."""
    head = ",".join(one.name for one in fields(Stay))
    lines = (
        ",".join(
            [
                '"' + stay.area.replace('"', '""') + '"',
                *(f"{value:.3f}" for value in astuple(stay)[1:]),
            ]
        )
        for stay in stays
    )
    write_text(path, "\n".join([head, *lines, ""]))


def sentences(stays: Sequence[Stay]) -> Iterator[str]:
    """Yield a sentence for each area that was visited, and for each place where the tag was parked."""
    for name in dict.fromkeys(stay.area for stay in stays if stay.area != PARKED):
        mine = [stay.seconds for stay in stays if stay.area == name]
        yield f"in {name} for {sum(mine):.0f} s, in {len(mine)} visit{'s' * (len(mine) > 1)}"
    for stay in stays:
        if stay.area == PARKED:
            yield f"parked at ({stay.x:.1f}, {stay.y:.1f}) m for {stay.seconds:.0f} s"


def draw_tracks(path: Path, tags: Mapping[str, tuple[Track, Sequence[Stay]]], areas: Areas) -> None:
    """Draw the tracks of all tags from above, {name: (track, stays)}, with areas and parked tags."""
    from matplotlib.figure import Figure  # takes a second to import

    figure = Figure(figsize=(9.0, 8.0), layout="constrained")
    ax = figure.subplots()
    for name, corners in areas.items():
        ax.fill(*corners.T, color="0.88", zorder=0)
        x, y = corners.mean(axis=0).tolist()
        ax.text(x, y, name, ha="center", color="0.4", fontsize=9)
    for name, (track, stays) in tags.items():
        (line,) = ax.plot(*track.p.T, lw=1.0, label=name)
        for stay in stays:
            if stay.area == PARKED:
                ax.plot(stay.x, stay.y, "s", ms=8, color=line.get_color())
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    ax.set_title(f"tags from above; squares: parked for {LONG:.0f} s or longer")
    ax.grid(alpha=0.25)
    ax.legend(loc="best", fontsize=8)
    write_picture(path, figure)
