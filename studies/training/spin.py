# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""spin: simulate a tag that spins between two anchors, and draw the error of their TDOA over yaw.

There are several orientations of anchor 0, and five specimens of the tag. The counterpart is figure
4 of Zhao et al. (2021).
"""

from functools import partial

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.files import write_filled
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.effects import true_samples
from uwb_tdoa_tools.outputs import OutputFile
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

POSITIONS = ((0.0, 0.0, 1.2), (5.0, 0.0, 1.2))  # m, of the anchors 0 and 1
PLACE, HEIGHT = (2.2, 1.5), 1.3  # m, of the tag
TURNS = (0.0, 45.0, 90.0, 135.0)  # degrees about its vertical, of anchor 0
TAGS = range(5)
BIN = 10.0  # degrees


def add_options(add):
    """The options of the study."""
    add("--out", metavar="FILE", type=OutputFile, required=True, help="picture to write")
    add("--seed", metavar="N", type=int, default=0, help="of the noise (default: 0)")


def run(args):
    """Draw the picture, and print how far the curves are apart."""
    anchors = {f"anchor 0 turned by {turn:g} deg": (turn, 0) for turn in TURNS}
    tags = {f"tag {unit}": (TURNS[0], unit) for unit in TAGS}
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.8), sharey=True, layout="constrained")
    for ax, cases in zip(axes, (anchors, tags)):
        curves = [over_yaw(*case, args.seed) for case in cases.values()]
        for name, (yaw, error) in zip(cases, curves):
            ax.plot(yaw, 100.0 * error, ".-", ms=4, lw=1, label=name)
        apart = 100.0 * np.sqrt(np.mean(np.var([error for _, error in curves], axis=0)))
        size = 100.0 * np.mean([np.std(error) for _, error in curves])
        first = next(iter(cases))
        print(
            f"{len(cases)} curves, {first} ...: spread over the yaw {size:.1f} cm, between "
            f"them {apart:.1f} cm"
        )
        ax.set(xlabel="yaw of the tag [deg]", xticks=range(0, 361, 90))
        ax.grid(alpha=0.3)
        ax.legend(fontsize="small")
    axes[0].set_ylabel("error of d_01, median of 10 deg [cm]")
    write_filled(args.out, partial(figure.savefig, dpi=110))
    plt.close(figure)
    print(f"wrote {args.out}")


def over_yaw(turn, unit, seed=0):
    """(yaw (36,) degrees, error of d_01 (36,) m, median of each bin) of a spinning tag.

    turn : degrees by which anchor 0 is turned about its vertical; unit : specimen of the tag.
    """
    facing = Rotation.from_euler("z", [[turn], [180.0]], degrees=True).as_quat()
    config = SimulationConfig(
        seed=seed,
        anchors=Anchors(np.array([0, 1]), np.array(POSITIONS), facing),
        trajectory="spin",
        place=PLACE,
        height=HEIGHT,
        duration=26.0,
        start_in_air=True,
        imu_rate=100.0,
        tag_unit=unit,
        anchor_delay_std=0.0,
        multipath=False,
        outlier_probability=0.0,
    )
    flight = simulate(config)
    samples, rows = true_samples(flight)
    sign = np.where(samples.a == 0, 1.0, -1.0)
    error = sign * (flight.tdoa.d[rows] - tdoa(samples.p, samples.position_a, samples.position_b))
    yaw = Rotation.from_quat(samples.q).as_euler("ZYX", degrees=True)[:, 0] % 360.0
    which = (yaw / BIN).astype(int)
    bins = np.arange(round(360.0 / BIN))
    return (bins + 0.5) * BIN, np.array([np.median(error[which == k]) for k in bins])
