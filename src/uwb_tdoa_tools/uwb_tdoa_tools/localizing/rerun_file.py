"""A flight and its estimate for the viewer Rerun (rerun.io): anchors, path, covariance, residuals
per pair over time, verdict and findings.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.flight import Flight, Truth
from uwb_tdoa_ekf.results import Residuals

from ..diagnosis.output import as_text
from ..estimate import FlightEstimator
from ..scoring.metrics import position_at
from .pictures import SIGMAS
from .residuals import by_pair

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from types import ModuleType

    from uwb_tdoa_bias.effects import EffectSet
    from uwb_tdoa_ekf.core.config import FilterConfig
    from uwb_tdoa_ekf.results import Odometry

    from ..bags.bag import RecordedOdometry
    from ..diagnosis.result import Diagnosis

HELP = (
    "write a recording for the viewer Rerun, too (.rrd; of one flight; needs pip install rerun-sdk)"
)
RATE = 20.0  # Hz, of poses that are written
BLUE, RED, GREY, BLACK, ORANGE = (
    (31, 119, 180),
    (214, 39, 40),
    (120, 120, 120),
    (40, 40, 40),
    (255, 127, 14),
)


def is_there(say: Callable[[str], object]) -> bool:
    """Whether the library is installed; say(sentence) : called if not."""
    if find_spec("rerun") is not None:
        return True
    say(
        "--rerun is left out: the viewer's library is not installed; pip install rerun-sdk "
        "(it needs numpy 2)."
    )
    return False


def write_rerun(
    path: Path,
    flight: Flight,
    odometry: Odometry | RecordedOdometry,
    residuals: Residuals | None,
    verdict: Sequence[str],
    truth: Truth | None = None,
    before: Odometry | RecordedOdometry | None = None,
) -> None:
    """Write a .rrd file: the Odometry of a Flight among its anchors, Residuals or None, sentences,
    the ground truth where it is to be shown, and another Odometry, as it was before something was
    corrected, or None. Time is s since the first TDOA.
    """
    import rerun

    begin = flight.start
    stream = rerun.RecordingStream("uwb_tdoa")
    stream.save(path)
    anchors = flight.anchors
    labels = [str(number) for number in anchors.ids.tolist()]
    stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log(
        "world/anchors",
        rerun.Points3D(anchors.positions, labels=labels, radii=0.06, colors=BLACK),
        static=True,
    )
    stream.log(
        "world/path", rerun.LineStrips3D([odometry.p], colors=BLUE, radii=0.005), static=True
    )
    stream.log(
        "verdict", rerun.TextDocument("\n\n".join(verdict), media_type="text/markdown"), static=True
    )
    if truth is not None:
        stream.log(
            "world/truth", rerun.LineStrips3D([truth.p], colors=GREY, radii=0.005), static=True
        )
    _write_poses(rerun, stream, odometry, begin)
    std = np.sqrt(np.einsum("nii->ni", odometry.covariance[:, :3, :3]))
    for k, axis in enumerate("xyz"):
        _write_scalars(rerun, stream, f"deviation/{axis}", odometry.t - begin, std[:, k])
    for one in by_pair(residuals) if residuals is not None else ():
        _write_scalars(rerun, stream, f"residual/{one.a}-{one.b}", one.t - begin, one.value)
    if before is not None:
        stream.log(
            "world/before", rerun.LineStrips3D([before.p], colors=ORANGE, radii=0.005), static=True
        )
    if truth is not None:
        for name, estimate in (("error", odometry), ("error/before", before)):
            if estimate is not None:
                error = np.linalg.norm(estimate.p - position_at(estimate.t, truth), axis=1)
                _write_scalars(rerun, stream, name, estimate.t - begin, error)
    stream.flush()
    stream.disconnect()


def write_diagnosis(
    path: Path, result: Diagnosis, base: EffectSet, config: FilterConfig | None
) -> None:
    """Write the single flight of a Diagnosis: estimates with the EffectSet `base` and with what was
    found, what that is, and the ground truth as it was judged by.
    """
    (flight,) = result.flights
    before, after = (FlightEstimator(config, effects)(flight) for effects in (base, result.effects))
    truth = flight.truth if result.reference.tells_errors else None
    write_rerun(
        path,
        flight,
        after.odometry,
        after.residuals,
        as_text(result).splitlines(),
        truth,
        before.odometry,
    )


def _write_poses(
    rerun: ModuleType, stream: Any, odometry: Odometry | RecordedOdometry, begin: float
) -> None:
    """The tag and its ellipsoid of three standard deviations, at most RATE times a second."""
    cells = np.floor((odometry.t - begin) * RATE) if len(odometry.t) else np.zeros(0)
    rows = np.flatnonzero(np.diff(cells, prepend=-np.inf) > 0.0)
    values, vectors = np.linalg.eigh(odometry.covariance[rows, :3, :3])
    vectors *= np.sign(np.linalg.det(vectors))[:, None, None]  # right-handed
    turned = Rotation.from_matrix(vectors).as_quat() if len(rows) else np.zeros((0, 4))
    half = SIGMAS * np.sqrt(np.maximum(values, 0.0))
    for row, size, q in zip(rows.tolist(), half, turned):
        stream.set_time("time", duration=float(odometry.t[row] - begin))
        stream.log("world/tag", rerun.Points3D([odometry.p[row]], radii=0.04, colors=RED))
        stream.log(
            "world/tag/3_sigma",
            rerun.Ellipsoids3D(
                centers=[odometry.p[row]],
                half_sizes=[size],
                quaternions=[rerun.Quaternion(xyzw=q)],
                colors=RED,
            ),
        )
    stream.reset_time()


def _write_scalars(
    rerun: ModuleType, stream: Any, name: str, t: np.ndarray, values: np.ndarray
) -> None:
    """A curve over time, s."""
    known = np.isfinite(values)
    stream.send_columns(
        name,
        indexes=[rerun.TimeColumn("time", duration=t[known])],
        columns=rerun.Scalars.columns(scalars=values[known]),
    )
