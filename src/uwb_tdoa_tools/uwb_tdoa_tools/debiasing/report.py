"""What debias says: rows of flights, Markdown tables, and a picture."""

import numpy as np

from ..scoring.plots import plt
from .judge import judge

_RUN = ("rmse_x", "rmse_y", "rmse_z", "rmse_3d", "max_3d", "nees_mean")


def about(bias_map):
    """One line on a BiasMap."""
    figures = about_figures(bias_map)
    added = ", ".join(f"{std:.3f}" for std in figures["added_std"])
    return (
        f"{figures['markers']} markers {figures['step']:g} m apart, "
        f"root mean square of the bias {figures['bias_rms']:.3f} m; "
        f"standard deviations added to a corrected position {added} m"
    )


def about_figures(bias_map):
    """The same for JSON."""
    return {
        "markers": len(bias_map.at),
        "step": bias_map.step,
        "interpolator": bias_map.interpolator,
        "planar": bias_map.planar,
        "frame": bias_map.frame,
        "source": bias_map.source,
        "bias_rms": float(np.sqrt(np.mean(np.sum(bias_map.bias**2, axis=1)))),
        "added_std": np.sqrt(np.diag(bias_map.added)).tolist(),
    }


def rows(flown, bias_map, effects=None):
    """[{"flight", "before": figures, "after": figures, "known"}] of what `fly` gave. known : share of the positions
    that the map knows."""
    out = []
    for flight, score, odometry in flown:
        after = judge((flight, score, odometry), bias_map, effects)
        sides = {"before": score.row(), "after": after.row()}
        airborne = odometry.p[(odometry.t >= score.first) & (odometry.t <= score.last)]
        figures = {side: {name: row[name] for name in _RUN} for side, row in sides.items()}
        out.append({"flight": flight.name, **figures, "known": float(np.mean(bias_map.validity(airborne) == 1.0))})
    return out


def say_rows(title, found):
    """Print rows, and their mean."""
    if not found:
        return
    print(f"{title:24s}   before: x       y       z      3D    NEES   after: x       y       z      3D    NEES   known")
    for row in found:
        print(
            f"{row['flight']:24s}" + "".join(_side(row[side]) for side in ("before", "after")) + f"{row['known']:8.0%}"
        )
    before, after = (np.mean([row[side]["rmse_3d"] for row in found]) for side in ("before", "after"))
    print(f"mean 3D RMSE {before:.3f} m before, {after:.3f} m after ({after / before - 1:+.0%})")


def _side(figures):
    return "  " + "".join(f"{figures[name]:8.3f}" for name in ("rmse_x", "rmse_y", "rmse_z", "rmse_3d", "nees_mean"))


def set_up_tables(figures):
    """Markdown of what set_up.run found, in centimetres, coordinates as in the paper: from the corner."""
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
    lines += [_line([edge, *(f"{100 * row[name]:.1f}" for name in names)]) for edge, row in figures["square"].items()]
    lines += [
        "",
        "Layers of appendix C before the map, square path: RMSE, and change of the error between positions, cm.",
        "",
    ]
    lines += _head(["layers", "RMSE", "change"])
    lines += [
        _line([name, f"{100 * row['rmse']:.2f}", f"{100 * row['step']:.3f}"]) for name, row in figures["layers"].items()
    ]
    return "\n".join(lines) + "\n"


def measured_tables(figures):
    """Markdown of what measured.run found: means of the runs, m, and beneath them every run."""
    names = list(dict.fromkeys(name for case in figures for row in case["runs"] for name in row if name != "flight"))
    lines = []
    for title, key in (("3D RMSE, m", "rmse"), ("Horizontal RMSE, m", "rmse_xy"), ("NEES (3 is honest)", "nees")):
        lines += [f"{title}, mean of the runs.", "", *_head(["fitted to", "runs", *names])]
        lines += [_line([case["case"], len(case["runs"]), *_means(case["runs"], names, key)]) for case in figures] + [
            ""
        ]
    lines += ["3D RMSE of every run, m.", "", *_head(["fitted to", "flight", *names])]
    lines += [
        _line([case["case"], row["flight"], *_means([row], names, "rmse")]) for case in figures for row in case["runs"]
    ]
    return "\n".join(lines) + "\n"


def _means(runs, names, key):
    return [f"{np.mean([row[name][key] for row in runs]):.3f}" if name in runs[0] else "" for name in names]


def _cm(values, *keys):
    return " / ".join(f"{100 * values[key]:.1f}" for key in keys)


def _head(cells):
    return [_line(cells), _line(["---"] + ["---:"] * (len(cells) - 1))]


def _line(cells):
    return "| " + " | ".join(map(str, cells)) + " |"


def plot_set_up(found, maps, path):
    """Bias before and after the static maps, as arrows from the true place, five times as long."""
    sides = {"before": None, "network": maps["static, network"], "thin plate": maps["static, thin_plate"]}
    figure, axes = plt.subplots(1, 3, figsize=(13, 5.7), layout="constrained", sharey=True)
    for ax, (title, one) in zip(axes, sides.items()):
        for name, colour in (("calibration", "tab:gray"), ("validation", "tab:red")):
            true = np.array([stay.true[0, :2] for stay in found[name]])
            bias = np.array([_mean_error(stay, one) for stay in found[name]])
            ax.quiver(*true.T, *bias.T, angles="xy", scale_units="xy", scale=0.2, color=colour, width=0.004, label=name)
        size = np.mean([np.hypot(*_mean_error(stay, one)) for stay in found["validation"]])
        ax.set(
            title=f"{title}: {100 * size:.1f} cm at the validation points",
            xlabel="x, m",
            aspect="equal",
            xlim=(-2.7, 2.9),
            ylim=(-2.6, 3.3),
        )
        ax.plot([-2, 2, 2, -2], [-2, -2, 2, 2], "k^")
    axes[0].set_ylabel("y, m")
    axes[0].legend(loc="upper right", fontsize="small")
    figure.suptitle("Bias of the position, arrows five times as long as the bias")
    figure.savefig(path, dpi=80)
    plt.close(figure)


def _mean_error(stay, one):
    p = stay.p if one is None else one.correct(stay.p, stay.covariance)[0]
    return (p - stay.true).mean(axis=0)[:2]
