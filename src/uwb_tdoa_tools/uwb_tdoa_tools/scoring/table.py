"""Errors as tables: lines for the screen, and Markdown, beside what others reach."""

from ..readers.tables import number, read_table

COLUMNS = {
    "rmse_x": "x", "rmse_y": "y", "rmse_z": "z", "rmse_3d": "3D", "median_3d": "median", "max_3d": "max",
    "frac_gt_1m": ">1 m", "nees_mean": "NEES", "nis_mean": "NIS", "start_delay": "delay",
}  # fmt: skip
ERRORS = ("rmse_x", "rmse_y", "rmse_z", "rmse_3d", "median_3d", "max_3d")


def head():
    """The line above those of `line`."""
    return _line("flight", COLUMNS.values())


def line(row):
    """One run, `Score.row`, or several, `pooled`."""
    word = ""
    if row["diverged"]:
        word = "  LATE START" if row["diverged"] == row["late_start"] else "  DIVERGED"
    return _line(row["flight"], (f"{row[key]:.3f}" for key in COLUMNS)) + word


def lines_of_errors(scores):
    """Lines of the errors alone, m, of several Scores of one flight."""
    titles = "".join(f"{COLUMNS[key]:>9s}" for key in ERRORS)
    rows = [f"{score.name:28s}" + "".join(f"{score.row()[key]:9.3f}" for key in ERRORS) for score in scores]
    return [f"{'error, m':28s}{titles}", *rows]


def markdown(rows, others):
    """The table of rows, in metres, with one column per other estimator, as `read_others` gives them."""
    table = [["flight", *COLUMNS.values(), *others]]
    table.append(["---"] + ["---:"] * (len(table[0]) - 1))
    for row in rows:
        cells = [f"{row[key]:.3f}" for key in COLUMNS] + [peer.get(row["flight"], "") for peer in others.values()]
        table.append([row["flight"], *cells])
    return "".join("| " + " | ".join(cells) + " |\n" for cells in table)


def read_others(path):
    """{peer and mode: {flight: 3D RMSE as text, or "diverged"}} of a CSV file. Raises InputError."""
    others = {}
    for line, row in read_table(path, ("flight", "peer", "mode", "rmse_3d", "diverged")):
        cell = "diverged" if row["diverged"] == "True" else f"{number(path, line, row, 'rmse_3d'):.3f}"
        others.setdefault(f"{row['peer']} {row['mode']}", {})[row["flight"]] = cell
    return others


def _line(first, cells):
    return f"{first:20s}" + "".join(f"{cell:>9s}" for cell in cells)
