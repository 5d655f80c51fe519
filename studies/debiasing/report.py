# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tables and a picture of docs/notebook/debiasing.md."""

from functools import partial

import matplotlib.pyplot as plt
import numpy as np

from uwb_tdoa_bias.common.files import write_filled


def set_up_tables(figures):
    """Markdown of the figures of set_up.copied, in centimetres.

    Coordinates count from the corner, as in the paper.
    """
    names = [name for name in figures["static"]["validation"] if name != "places"]
    lines = ["Mean of |bias| over the places: x / y / both, and the largest, cm.", ""]
    lines += _head(["", "places", *names])
    for kind, row in figures["static"].items():
        cells = (f"{_cm(row[n], 'x', 'y', 'both')}, {100 * row[n]['largest']:.1f}" for n in names)
        lines.append(_line([f"{kind} grid", row["places"], *cells]))
    lines += ["", "Rails, RMSE x / y, cm (as Table 1).", ""]
    lines += _head(["direction", "at, m", "speed, m/s", *names])
    for row in figures["rails"]:
        cells = (_cm(row[name], "x", "y") for name in names)
        lines.append(_line([row["direction"], f"{row['at']:g}", f"{row['speed']:.2f}", *cells]))
    lines += ["", "Square path, RMSE, cm (as Table 2).", ""]
    lines += _head(["edge", *names])
    lines += [
        _line([edge, *(f"{100 * row[name]:.1f}" for name in names)])
        for edge, row in figures["square"].items()
    ]
    return "\n".join(lines) + "\n"


def measured_tables(figures):
    """Markdown of the figures of measured.judged: means of the runs, m, then every run."""
    names = list(
        dict.fromkeys(
            name for case in figures for row in case["runs"] for name in row if name != "flight"
        )
    )
    lines = []
    for title, key in (
        ("3D RMSE, m", "rmse"),
        ("Horizontal RMSE, m", "rmse_xy"),
        ("NEES (3 is honest)", "nees"),
    ):
        lines += [f"{title}, mean of the runs.", "", *_head(["fitted to", "runs", *names])]
        lines += [
            _line([case["case"], len(case["runs"]), *_means(case["runs"], names, key)])
            for case in figures
        ] + [""]
    lines += ["3D RMSE of every run, m.", "", *_head(["fitted to", "flight", *names])]
    lines += [
        _line([case["case"], row["flight"], *_means([row], names, "rmse")])
        for case in figures
        for row in case["runs"]
    ]
    return "\n".join(lines) + "\n"


def _means(runs, names, key):
    return [
        f"{np.mean([row[name][key] for row in runs]):.3f}" if name in runs[0] else ""
        for name in names
    ]


def _cm(values, *keys):
    return " / ".join(f"{100 * values[key]:.1f}" for key in keys)


def _head(cells):
    return [_line(cells), _line(["---"] + ["---:"] * (len(cells) - 1))]


def _line(cells):
    return "| " + " | ".join(map(str, cells)) + " |"


def plot_set_up(found, maps, path):
    """Bias before and after the static maps, as arrows from the true place, five times as long."""
    sides = {
        "before": None,
        "network": maps["static, network"],
        "thin plate": maps["static, thin_plate"],
    }
    figure, axes = plt.subplots(2, 2, figsize=(7, 7.4), layout="constrained")
    for ax, (title, one) in zip(axes.ravel(), sides.items()):
        for name, colour in (("calibration", "tab:gray"), ("validation", "tab:red")):
            true = np.array([stay.true[0, :2] for stay in found[name]])
            bias = np.array([_mean_error(stay, one) for stay in found[name]])
            ax.quiver(
                *true.T,
                *bias.T,
                angles="xy",
                scale_units="xy",
                scale=0.2,
                color=colour,
                width=0.006,
                label=name,
            )
        size = np.mean([np.hypot(*_mean_error(stay, one)) for stay in found["validation"]])
        ax.set(
            xlabel="x, m",
            ylabel="y, m",
            aspect="equal",
            xlim=(-3.7, 3.7),
            ylim=(-2.6, 2.6),
        )
        ax.set_title(f"{title}: {100 * size:.1f} cm", fontsize=10)
        ax.plot([-2, 2, 2, -2], [-2, -2, 2, 2], "k^", label="anchor")
    axes[1, 1].axis("off")
    axes[1, 1].legend(*axes[0, 0].get_legend_handles_labels(), loc="center left", frameon=False)
    figure.suptitle(
        "Bias of the position, five times as long, and its mean at the validation points"
    )
    write_filled(path, partial(figure.savefig, dpi=100))
    plt.close(figure)


def _mean_error(stay, one):
    p = stay.p if one is None else one.correct(stay.p, stay.covariance)[0]
    return (p - stay.true).mean(axis=0)[:2]
