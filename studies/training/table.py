# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A comparison as text."""


def markdown(report):
    """The table of the result of `compare`: runs, and means of groups with the change of the error
    from the filter without a model.
    """
    kinds = [key for key in report["runs"][0] if key not in ("group", "flight")]
    lines = [["group", "flight", *kinds], ["---", "---"] + ["---:"] * len(kinds)]
    for group, means in report["groups"].items():
        runs = [row for row in report["runs"] if row["group"] == group]
        lines += [[group, row["flight"], *(f"{row[kind]:.3f}" for kind in kinds)] for row in runs]
        cells = [
            f"**{means[kind]:.3f}** ({means[kind] / means['none'] - 1.0:+.0%})" for kind in kinds
        ]
        lines.append([group, "**mean**", *cells])
    text = "".join("| " + " | ".join(cells) + " |\n" for cells in lines)
    text += "\nTDOAs, RMS after correction at the true pose, m: "
    text += ", ".join(f"{kind} {value:.3f}" for kind, value in report["tdoa_rms"].items())
    text += "\nmean squared error of a TDOA over its predicted variance: "
    text += (
        ", ".join(f"{kind} {value:.2f}" for kind, value in report["normalised_variance"].items())
        + "\n"
    )
    text += (
        "position, NEES (3 is honest) and share of the time inside three standard deviations, "
        "worst axis:\n"
    )
    for group, kinds in report["consistency"].items():
        text += (
            f"  {group}: "
            + ", ".join(f"{kind} {a:.1f} {b:.1%}" for kind, (a, b) in kinds.items())
            + "\n"
        )
    for name, (mean, pairs) in report.get("repeatability", {}).items():
        text += (
            f"residuals of two flights at one place, {name}: correlation {mean:.2f} ({pairs} "
            "pairs of flights)\n"
        )
    return text
