# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Read recordings of others by a Profile: bags of ROS 1 and ROS 2, CSV files, ULog; arrays with units by name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
import re
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors, refuse_faulty
from uwb_tdoa_bias.common.errors import InputError, number_of
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.survey import Entry, NamedAnchors, as_named, name_of, named_anchors

from ..bags import is_bag, is_ros_1
from .profile import (
    ANCHORS,
    ATTITUDE,
    EMPTY,
    MOST_SKIPPED,
    RADIO,
    STREAMS,
    TIMES,
    Columns,
    Profile,
    Source,
    check_columns,
    parse_column,
    parts_of,
)
from .streams import Streams, by_time, make_flight
from .tables import Block, CsvFiles, Foreign, ULogFile, Wanted, is_ulog

SURVEY = "anchors"  # stream of positions
ENDS = ".csv", ".csv.gz", ".jsonl", ".bag", ".ulg"  # of names of recordings
SINGLE = "gyro", "acc", "pose", "tof", "baro", "flow"  # streams of one sensor each
MOST_LISTED = 8  # columns in a sentence
THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")  # as 1,000
AN_ANCHOR = "an anchor of the survey, by its name, or an id 0 ... 65535"
MOVED = 0.1  # m that the recorded position of an anchor changes, above which it is reported
_MOMENT = re.compile(
    r"(?=\d)(?:(\d{4})[-/](\d\d?)[-/](\d\d?))?[T ]*(?:(\d\d?):(\d\d):(\d\d(?:[.,]\d+)?))?"
    r"\s*(?:Z|UTC|([-+]\d\d):?(\d\d))?"
)
AXES = {  # of a Source: rotation to ours
    "enu": np.eye(3),
    "ned": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    "flu": np.eye(3),
    "frd": np.diag([1.0, -1.0, -1.0]),
}


@contextmanager
def open_recording(
    paths: Sequence[Path], types: dict[str, str] | None = None, salvage: bool = False
) -> Iterator[Foreign]:
    """Yield the tables of files that are one recording. Raises InputError.

    Parameters
    ----------
    paths : bags, CSV files, one ULog file, or one folder of these.
    types : {type: definition} for bags that have none.
    salvage : read the sound part of a damaged file.
    """
    files = files_of(paths)
    bags = [path for path in files if is_bag(path) or is_ros_1(path)]
    if bags and len(bags) < len(files):
        other = next(path for path in files if path not in bags)
        raise InputError(f"{other}: is no bag, as {bags[0]} is; give recordings of one kind.")
    if bags:
        from .foreign_bags import open_foreign  # only bags need the rosbags library

        with open_foreign(bags, types or {}) as bag:
            yield bag
    elif is_ulog(files[0]):
        yield ULogFile(files, salvage)
    else:
        yield CsvFiles(files, salvage)


def files_of(paths: Sequence[Path]) -> list[Path]:
    """Return the files of a recording; those in a folder belong together. Raises InputError."""
    found: list[Path] = []
    for path in paths:
        if not path.exists():
            raise InputError(f"{path}: does not exist; give a recording.")
        inside = [path]
        if path.is_dir() and not is_bag(path):
            inside = [
                file for file in sorted(path.iterdir()) if file.name.endswith(ENDS) or is_bag(file)
            ]
        if not inside:
            raise InputError(
                f"{path}: holds no CSV file, JSON lines, bag or ULog; give the files themselves."
            )
        found += inside
    return found


def read_by_profile(
    paths: Sequence[str | Path],
    profile: Profile,
    survey: NamedAnchors | None = None,
    tag: str = "",
    namespace: str = "",
    salvage: bool = False,
    truth: bool = True,
) -> Flight:
    """Read the Flight of a recording of others.

    A record counts for a stream if any of its cells is filled. Records with empty or invalid cells are skipped and counted in
    `meta["remarks"]`. `meta["read"]` and `meta["unread"]` are sentences on what was read, and what was not.

    Parameters
    ----------
    paths : its files, or a folder.
    profile : what the tables and fields of the recording mean.
    survey : anchors; None for those in the recording.
    tag : id of the tag, if the recording has several.
    namespace : of the topics that count, where several fit to the profile.
    salvage : skip invalid records even if they exceed MOST_SKIPPED.
    truth : read the ground truth.

    Raises InputError with the place of the first invalid record, if they exceed MOST_SKIPPED.
    """
    files = [Path(path) for path in paths]
    with open_recording(files, profile.types, salvage) as tables:
        named, streams, meta = streams_of(
            tables, files[0], profile, survey, tag, namespace, salvage
        )
    meta = {"source": ", ".join(map(str, paths)), **meta}
    if antenna := profile.antenna.get(tag) or profile.antenna.get(""):
        meta["antenna"] = list(antenna)
    if named.ids:
        meta["anchor_ids"] = named.ids
    name = flight_name(files[0]) + f"_tag{tag}" * bool(tag)
    return make_flight(name, named.anchors, streams, {}, meta, salvage, truth)


def streams_of(
    tables: Foreign,
    path: str | Path,
    profile: Profile,
    survey: NamedAnchors | None,
    tag: str = "",
    namespace: str = "",
    salvage: bool = False,
) -> tuple[NamedAnchors, Streams, dict[str, Any]]:
    """Return the anchors, the streams and the `meta` of tables, as `make_flight` takes them.

    path : for messages; others see `read_by_profile`. Raises InputError.
    """
    remarks: list[str] = []
    requests = _requests(tables, profile, path, namespace, remarks, survey is not None)
    wanted = [one for one in requests if one.gives]
    for block in tables.blocks([one.wanted for one in wanted]):
        wanted[block.number].take(block, tag)
    named = survey or _recorded_anchors(tables, wanted, path, remarks)
    parts: dict[str, list[tuple[str, dict[str, np.ndarray]]]] = {}
    for request in wanted:
        for stream, columns in request.streams(named, remarks, salvage).items():
            parts.setdefault(stream, []).append((request.table, columns))
    _check_tag(path, requests, tag)
    for stream, found in parts.items():
        if stream in SINGLE and len(found) > 1:
            raise InputError(
                f"{path}: {' and '.join(table for table, _ in found)} both give {stream}, which is of one "
                "sensor; leave one of them out of the profile."
            )
        if isinstance(tables, CsvFiles) and not any(source.topic for source in profile.sources):
            _refuse_same_anchors(found)
    meta: dict[str, Any] = {
        "format": profile.name,
        "remarks": remarks + tables.remarks,
        "read": [sentence for request in wanted for sentence in request.sentences(tables)],
        "unread": _unread(tables, requests),
    }
    return named, {name: _joined([one for _, one in found]) for name, found in parts.items()}, meta


def flight_name(path: Path) -> str:
    """Return the name of a Flight by that of its file or folder."""
    stem = path.name.removesuffix(".gz")
    return Path(stem).stem if path.is_file() else stem


class _Request:
    """The streams of one source in one table, and the records read so far.

    Attributes
    ----------
    wanted : the fields to read.
    gives : names of the streams of the source.
    tags : {tag: records}.
    """

    def __init__(
        self,
        table: str,
        source: Source,
        names: dict[str, str],
        tables: Foreign,
        held: bool,
        has_survey: bool,
    ) -> None:
        """Prepare to read a source of a table.

        Parameters
        ----------
        names : {name in a pattern: text}.
        held : leave out records that repeat the last one.
        has_survey : leave out positions of anchors.
        """
        self.table, self.source, self._names, self._held = table, source, names, held
        self._place, default = tables.place, tables.time
        # Then a comma in a cell may be a thousands separator.
        self._between_commas = isinstance(tables, CsvFiles) and tables.delimiters[table] == ","
        self._columns = _wanted(source, default)
        if has_survey:
            self._columns.pop(SURVEY, None)
        self.gives = {*self._columns}
        if any("t" not in mine for stream, mine in self._columns.items() if stream != SURVEY):
            raise InputError(f"{table}: names no column with the time; write time: COLUMN.")
        self.wanted = Wanted(
            table, source.each, tuple(_paths(source, self._columns.values()) - {*names})
        )
        self._by_stamp = default in [mine.get("t", ()) for mine in self._columns.values()]
        self._ids: dict[str, int] = {}  # {name of an anchor: its number in the columns of ids}
        self._read: dict[str, list[dict[str, np.ndarray]]] = {
            stream: [] for stream in self._columns
        }
        self._wrong: dict[tuple[str, str], Any] = {}  # {(stream, column): first that is no number}
        self._stamps: dict[str, np.ndarray] = {}
        self._last: dict[str, tuple[Any, ...]] = {}
        self.tags: Counter[str] = Counter()
        self._left_out = self._repeats = 0

    def take(self, block: Block, tag: str) -> None:
        """Add the records of a block; of a recording with several tags, those of one."""
        met = np.ones(len(block.places), bool)
        for condition in self.source.where:
            met &= [condition.met(value) for value in self._column(block, condition.path)]
        self._left_out += np.count_nonzero(~met)
        of_tag = met
        if self.source.tag:
            tags = np.array([*map(name_of, self._column(block, self.source.tag))], str)
            self.tags.update(tags[met].tolist())
            of_tag = met & (tags == tag) if tag else met
        for stream, mine in self._columns.items():
            raw = {name: self._column(block, path) for name, (path, _) in mine.items()}
            records = [*zip(*(column for name, column in raw.items() if name != "t"))]
            rows = np.flatnonzero(met if stream == SURVEY else of_tag).tolist()
            kept = [k for k in rows if self._counts(stream, records[k])]
            columns = {"place": np.array([block.places[k] for k in kept], np.int64)}
            for name, column in raw.items():
                cells = column if len(kept) == len(column) else [column[k] for k in kept]
                if name in ANCHORS:
                    names = {cell: name_of(cell) for cell in dict.fromkeys(cells)}
                    numbers = [self._ids.setdefault(names[cell], len(self._ids)) for cell in cells]
                    columns[name] = np.array(numbers, np.int64)
                else:
                    columns[name] = self._numbers(stream, name, cells, columns["place"])
            self._read[stream].append(columns)

    def _column(self, block: Block, path: str) -> Sequence[Any]:
        """Return the values at a path; sums of times in s, "" where a part is none."""
        if path in self._names:
            return [self._names[path]] * len(block.places)
        if path in block.columns:
            return block.columns[path]
        parts = parts_of(path)
        times = zip(*(map(as_time, block.columns[part]) for part, _ in parts))
        return [
            "" if None in each else sum(t * factor for t, (_, factor) in zip(each, parts))
            for each in times
        ]

    def _counts(self, stream: str, values: tuple[Any, ...]) -> bool:
        """Return whether a record has a filled cell and, where a value is held, differs from the last one."""
        if all(isinstance(each, str) and each.lower() in EMPTY for each in values):
            return False
        if self._held and values == self._last.get(stream):
            self._repeats += 1
            return False
        self._last[stream] = values
        return True

    def _numbers(
        self, stream: str, name: str, cells: Sequence[Any], places: np.ndarray
    ) -> np.ndarray:
        """Return numbers, NaN for other cells. Raises InputError if a comma may be a thousands separator."""
        parse = as_time if name == "t" else as_number
        try:
            numbers = np.array(cells, float)
        except (TypeError, ValueError):
            for cell, place in zip(cells, places) if self._between_commas and name != "t" else ():
                if THOUSANDS.fullmatch(cell):
                    column = self._columns[stream][name][0]
                    raise InputError(
                        f"{self.table}: line {place}: {column} is {cell!r}, with a thousands separator or a "
                        "decimal comma; write a decimal point, or put semicolons between the cells."
                    ) from None
            numbers = np.array([parse(cell) for cell in cells], float)
        wrong = ~np.isfinite(numbers)
        if wrong.any():
            self._wrong.setdefault((stream, name), cells[int(np.argmax(wrong))])
        return np.where(wrong, np.nan, numbers)

    def surveyed(self, remarks: list[str]) -> dict[str, np.ndarray]:
        """Return {name of an anchor: (3,) m} in our axes: the last position, and report changes."""
        columns, out = self._all(SURVEY), {}
        if not columns:
            return {}
        factors = [self._columns[SURVEY][f"anchor_{axis}"][1] for axis in "xyz"]
        places = np.stack([columns[f"anchor_{axis}"] for axis in "xyz"], axis=1) * factors
        known, names = np.isfinite(places).all(axis=1), [*self._ids]
        for number in dict.fromkeys(columns["anchor_id"][known].tolist()):
            mine = places[known & (columns["anchor_id"] == number)]
            placed = mine[
                mine.any(axis=1)
            ]  # drivers write zeros where they do not know the position
            out[names[number]] = AXES[self.source.world] @ (placed if len(placed) else mine)[-1]
            shift = np.abs(np.diff(placed, axis=0)).max(initial=0.0)
            if shift > MOVED:
                remarks.append(
                    f"{self.table}: the position of anchor {names[number]} changes by {shift:.2f} m; "
                    "the last one counts."
                )
        return out

    def _all(self, stream: str) -> dict[str, np.ndarray]:
        """Return {column: (n,) numbers} of all records of a stream, without units."""
        parts = self._read.get(stream, [])
        return {name: np.concatenate([part[name] for part in parts]) for name in (parts or [{}])[0]}

    def streams(self, named: NamedAnchors, remarks: list[str], salvage: bool) -> Streams:
        """Return {stream: {column: (n,) array}} in the units of `make_flight`.

        Raises InputError for more than MOST_SKIPPED invalid records.
        """
        out: Streams = {}
        ids = np.array([named.id_of(text) for text in self._ids], float)  # NaN: unknown
        for stream in self._columns:
            if stream == SURVEY:
                continue
            columns = self._all(stream)
            places = columns.pop("place", np.zeros(0))
            numbers = {
                name: ids[values] if name in ANCHORS else values for name, values in columns.items()
            }
            bad = np.any([np.isnan(values) for values in numbers.values()], axis=0)
            if np.any(bad):
                row, n, count = int(np.argmax(bad)), len(bad), np.count_nonzero(bad)
                wrong = next(name for name in numbers if np.isnan(numbers[name][row]))
                is_id = wrong in ANCHORS
                cell = [*self._ids][columns[wrong][row]] if is_id else self._wrong[stream, wrong]
                first = (
                    f"{self._place} {places[row]}: {self._columns[stream][wrong][0]} is "
                    f"{str(cell)[:40]!r}; it must be {AN_ANCHOR if is_id else 'a finite number'}"
                )
                if count > MOST_SKIPPED * n and not salvage:
                    raise InputError(
                        f"{self.table}: {first} ({count} of {n} records of "
                        f"{', '.join(name for name in numbers if name != 't')} are like that: more "
                        "than a gap)."
                    )
                remarks.append(f"{self.table}: {count} of {n} records left out, {first}.")
            arrays = {
                name: values[~bad] * self._columns[stream][name][1]
                for name, values in numbers.items()
            }
            self._stamps[stream] = arrays.get("t", np.zeros(0))
            if len(self._stamps[stream]):
                out[stream] = _in_our_axes(stream, arrays, self.source)
        return out

    def sentences(self, tables: Foreign) -> Iterator[str]:
        """Yield what was read, with counts and seconds."""
        of = self._names.values() if self._held else ()
        for stream in self._columns:
            if stream in self._stamps:
                t = self._stamps[stream]
                span = f", {t.min():.1f} to {t.max():.1f} s" if len(t) else ""
                yield f"{self.table}: {len(t)} records of {' '.join([stream, *of])}{span}"
            elif columns := self._all(stream):
                count = len(np.unique(columns["anchor_id"]))
                yield f"{self.table}: positions of {count} anchors"
        if self._repeats:
            yield f"{self.table}: {self._repeats} values of {' '.join(of)} repeat the last one"
        unstamped = tables.unstamped[self.table]
        if unstamped and self._by_stamp:
            yield f"{self.table}: {unstamped} messages without a stamp: the time of recording counts"
        if self._left_out and self._stamps:
            paths = ", ".join(condition.path for condition in self.source.where)
            yield f"{self.table}: {self._left_out} records do not meet the condition on {paths}"


def _in_our_axes(
    stream: str, arrays: dict[str, np.ndarray], source: Source
) -> dict[str, np.ndarray]:
    """Return the columns of a stream, by their names in `make_flight`, in our axes."""
    out = {
        "t" if name == "t" else STREAMS[stream][name][0]: values for name, values in arrays.items()
    }
    if stream in ("gyro", "acc") and source.body == "frd":
        out["y"], out["z"] = -out["y"], -out["z"]
    if stream == "pose" and source.world == "ned":
        out.update(zip("xyz", AXES["ned"] @ np.stack([out[axis] for axis in "xyz"])))
    if stream == "pose" and ATTITUDE <= arrays.keys():
        q = np.stack([out[f"q{k}"] for k in "xyzw"], axis=1)
        known = np.isfinite(q).all(axis=1) & (np.abs(q).max(axis=1) > 0.0)
        if source.world == "ned" or source.body == "frd":
            turned = Rotation.from_quat(np.where(known[:, None], q, [0.0, 0.0, 0.0, 1.0]))
            matrices = AXES[source.world] @ turned.as_matrix() @ AXES[source.body]
            q = Rotation.from_matrix(matrices).as_quat()
        out.update(zip((f"q{k}" for k in "xyzw"), np.where(known[:, None], q, np.nan).T))
    return out


def _requests(
    tables: Foreign,
    profile: Profile,
    path: str | Path,
    namespace: str,
    remarks: list[str],
    has_survey: bool,
) -> list[_Request]:
    """Return the requests of all sources. Raises InputError."""
    requests = []
    for number, source in enumerate(profile.sources, start=1):
        found: dict[str, dict[str, str]] = {}
        if isinstance(tables, CsvFiles) and not source.topic:
            found = {table: {} for table in _csv_with_columns(tables, source)}
        else:
            for table, kind in tables.types.items() if source.topic or source.type else ():
                names = source.match(tables.topic(table), kind)
                if names is not None:
                    found[table] = names
            if not found:
                what = source.topic or source.type
                remarks.append(f"the recording has no {what}, source {number} of the profile.")
            if len(found) > 1 and not any(found.values()):
                found = _in_namespace(path, found, namespace)
        requests += [
            _Request(table, one, names | more, tables, bool(more), has_survey)
            for table, names in found.items()
            for one, more in source.over(tables.fields(table))
        ]
    if not any(request.gives & {*RADIO} for request in requests):
        raise InputError(
            f"{path}: has nothing that the profile {profile.name} takes TDOAs or ranges from; it "
            f"has {', '.join(sorted(tables.types)) or 'nothing'}."
        )
    return requests


def _in_namespace(
    path: str | Path, found: dict[str, dict[str, str]], namespace: str
) -> dict[str, dict[str, str]]:
    """Return the one table in a namespace. Raises InputError unless there is one."""
    prefix = f"/{namespace.strip('/')}/"
    inside = {table: names for table, names in found.items() if table.startswith(prefix)}
    if len(inside) == 1:
        return inside
    raise InputError(
        f"{path}: {' and '.join(sorted(found))} fit to one source of the profile; choose with "
        "--namespace, or write topic: into a profile of your own."
    )


def _csv_with_columns(tables: CsvFiles, source: Source) -> list[str]:
    """Return the paths of the CSV files that have all columns of a source: one, or all of one shape.

    Raises InputError for several shapes. If none has all columns, the error names a file that lacks
    the fewest.
    """
    lacking = {table: _lacking(source, tables.fields(table)) for table in tables.types}
    having = [table for table, columns in lacking.items() if not columns]
    other = next((one for one in having if tables.fields(one) != tables.fields(having[0])), None)
    if other:
        raise InputError(
            f"{other}: has column {min(_paths(source))!r} as {having[0]} has; give one of them."
        )
    if having:
        return having
    table = min(lacking, key=lambda each: len(lacking[each]))
    raise InputError(
        f"{table}: has no column {min(lacking[table])!r}; its columns are "
        f"{', '.join(tables.fields(table))}."
    )


def _lacking(source: Source, fields: Sequence[str]) -> set[str]:
    """Return the columns of a source that are not among the fields of a file."""
    fitting = source.over(fields)
    one, names = fitting[0] if fitting else (source, {})
    return _paths(one) - {*fields} - {*names}


def _paths(source: Source, columns: Iterable[Columns] | None = None) -> set[str]:
    """Return the columns that are read, also to decide which records count."""
    read = _wanted(source).values() if columns is None else columns
    paths = {path for mine in read for path, _ in mine.values()}
    deciding = {source.tag, *(condition.path for condition in source.where)} - {""}
    return {part for path in paths for part, _ in parts_of(path)} | deciding


def _wanted(source: Source, default: tuple[str, float] | None = None) -> dict[str, Columns]:
    """Return {stream: columns of a source, "t" with the time, or with `default` if it has none}."""
    wanted: dict[str, Columns] = {}
    for stream, known in STREAMS.items():
        mine = {name: source.columns[name] for name in known if name in source.columns}
        times = (source.columns.get(name) for name in (*TIMES[stream], "time"))
        time = next(filter(None, times), default)
        if mine:
            wanted[stream] = mine | ({"t": time} if time and stream != SURVEY else {})
    return wanted


def _recorded_anchors(
    tables: Foreign, requests: Sequence[_Request], path: str | Path, remarks: list[str]
) -> NamedAnchors:
    """Return the anchors in the recording. Raises InputError."""
    places: dict[str, np.ndarray] = {}
    for request in requests:
        places |= request.surveyed(remarks)
    if places:
        return named_anchors(path, [Entry(name, list(at)) for name, at in places.items()])
    recorded = tables.recorded_anchors()
    if recorded is not None:
        refuse_faulty(recorded.anchors, f"{path}: {recorded.source}")
        remarks.append(f"the {len(recorded.anchors)} anchors are those of {recorded.source}.")
        return NamedAnchors(recorded.anchors)
    raise InputError(
        f"{path}: does not say where the anchors are; give a survey file (--survey FILE)."
    )


def _refuse_same_anchors(found: Sequence[tuple[str, dict[str, np.ndarray]]]) -> None:
    """Raise InputError if several files of one shape hold the same anchor (pair): two recordings."""
    holder: dict[tuple[float, ...], str] = {}
    for table, columns in found:
        ids = [columns[name].tolist() for name in ("a", "b", "anchor") if name in columns]
        for anchors in dict.fromkeys(zip(*ids)):
            if holder.setdefault(anchors, table) != table:
                raise InputError(
                    f"{table}: has the columns and anchors that {holder[anchors]} has, as another "
                    "recording; give one of them."
                )


def _check_tag(path: str | Path, requests: Sequence[_Request], tag: str) -> None:
    """Raise InputError if the tag is not there, or is one of several and not named."""
    tags: Counter[str] = sum((request.tags for request in requests), Counter())
    listed = ", ".join(f"{name} ({count} records)" for name, count in sorted(tags.items()))
    if tag and not tags[tag]:
        raise InputError(
            f"{path}: has no record of tag {tag}; "
            + (f"its tags are {listed}." if tags else "the profile names no field with a tag.")
        )
    if len(tags) > 1 and not tag:
        raise InputError(
            f"{path}: has several tags: {listed}; choose one, --tag {min(tags)}, and read the "
            "others by further commands."
        )


def _joined(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return the columns of a stream from all its sources, sorted by time.

    A column that one of the sources lacks is left out.
    """
    names = set.intersection(*({*part} for part in parts))
    joined = {name: np.concatenate([part[name] for part in parts]) for name in sorted(names)}
    return by_time(joined) if len(parts) > 1 else joined


def _unread(tables: Foreign, requests: Sequence[_Request]) -> list[str]:
    """Return sentences on what the profile does not name."""
    named = {request.table for request in requests}
    if not isinstance(tables, CsvFiles):
        return [
            f"{table}: {tables.counts[table]} messages of {kind}, which the profile does not name"
            for table, kind in sorted(tables.types.items())
            if table not in named
        ]
    out = [f"{table}: the profile does not name it" for table in tables.types if table not in named]
    for table in sorted(named):
        used = {
            path
            for request in requests
            if request.table == table
            for path in _paths(request.source)
        }
        left = [name for name in tables.fields(table) if name and name not in used]
        if left:
            listed = ", ".join(left[:MOST_LISTED])
            more = f" and {len(left) - MOST_LISTED} more" if len(left) > MOST_LISTED else ""
            out.append(f"{table}: columns {listed}{more}, which the profile does not name")
    return out


def as_time(value: Any) -> float | None:
    """Return `as_number`, or the seconds of a date and time of ISO 8601; None if a value is neither.

    Without a date they count from midnight, without a zone the time is UTC.
    """
    number = as_number(value)
    moment = _MOMENT.fullmatch(value.strip()) if isinstance(value, str) else None
    if number is not None or moment is None:
        return number
    year, month, day, hour, minute, second, east, more = moment.groups(default="0")
    try:
        midnight = datetime(int(year) or 1970, int(month) or 1, int(day) or 1, tzinfo=timezone.utc)
    except ValueError:
        return None
    of_zone = int(east) * 3600 + int(f"{east[0]}{more}") * 60 if moment[7] else 0
    clock = int(hour) * 3600 + int(minute) * 60 + float(second.replace(",", "."))
    return midnight.timestamp() + clock - of_zone


def as_number(value: Any) -> float | None:
    """Return a finite number, with a decimal point or comma; None if a value is not one."""
    number = number_of(value.replace(",", ".") if isinstance(value, str) else value)
    return number if np.isfinite(number) else None


VECTORS = {"gyro": "xyz", "accel": "xyz", "pose": "xyz", "pose_q": "xyzw"}  # a column for each axis


def flight_of_arrays(
    anchors: Anchors | str | Path | Mapping[Any, Any],
    tables: Mapping[str, Any],
    units: Mapping[str, str] | None = None,
    name: str = "flight",
) -> Flight:
    """Return the Flight of some tables, each with the columns of some sensors.

    Parameters
    ----------
    anchors : Anchors, path of a survey, or {id or name: (x, y, z) in m}
    tables : {title: {column: (n,) values}}
        A column has the name that `--columns` gives it (docs/csv.md). "gyro", "accel" and "pose" may
        be (n, 3), "pose_q" (n, 4).
    units : {column: unit}, or {title: {column: unit}}
        Default: the first unit in docs/csv.md.
    name : str

    Raises
    ------
    InputError
        If a column or a unit is unknown or missing, or values are no numbers or of other lengths.
    """
    named, read, sources = _anchors_of(anchors), {}, []
    for title, table in tables.items():
        read[title] = _separate(title, table)
        columns = {column: _meaning(title, column, units or {}) for column in read[title]}
        check_columns(title, columns, time=False)
        sources.append(Source(columns, topic=title))
    profile = Profile("arrays", tuple(sources))
    _, streams, meta = streams_of(_Arrays(read), name, profile, named)
    meta |= {"source": name, "read": [], "unread": []}
    return make_flight(name, named.anchors, streams, {}, meta)


class _Arrays(Foreign):
    """Tables of arrays: {title: "arrays"}."""

    place = "row"

    def __init__(self, arrays: dict[str, dict[str, np.ndarray]]) -> None:
        super().__init__()
        self._arrays, self.types = arrays, dict.fromkeys(arrays, "arrays")
        self.columns = {table: [*columns] for table, columns in arrays.items()}

    def blocks(self, wanted: Sequence[Wanted]) -> Iterator[Block]:
        """Yield the rows of tables."""
        for number, (table, _, paths) in enumerate(wanted):
            columns = {path: self._arrays[table][path].tolist() for path in paths}
            yield Block(number, [*range(1, 1 + len(columns[paths[0]]))], columns)


def _anchors_of(anchors: Any) -> NamedAnchors:
    if isinstance(anchors, (Anchors, str, Path)) and (named := as_named(anchors)):
        return named
    if not isinstance(anchors, Mapping):
        raise InputError(
            f"anchors: is {type(anchors).__name__}; give Anchors, the path of a survey, or "
            "{id: (x, y, z)} in m."
        )
    entries = []
    for key, place in anchors.items():
        position = _numbers("anchors", str(key), place)
        if position.shape != (3,):
            raise InputError(
                f"anchors: {key} has {position.size} coordinates; give x, y and z in m."
            )
        entries.append(Entry(name_of(key), position.tolist()))
    return named_anchors("anchors", entries)


def _separate(title: str, table: Any) -> dict[str, Any]:
    """Return {column: (n,) values} of a table; a vector becomes a column for each axis."""
    names = getattr(getattr(table, "dtype", None), "names", None) or getattr(table, "keys", list)()
    out: dict[str, Any] = {}
    for name in map(str, names):
        values = table[name]
        axes = VECTORS.get(name)
        if axes is None:
            out[name] = np.asarray(values)
            continue
        rows = _numbers(title, name, values)
        if rows.ndim != 2 or rows.shape[1] != len(axes):
            raise InputError(
                f"{title}: {name} has the shape {rows.shape}; give (n, {len(axes)}): {axes}."
            )
        joint = name if name.endswith("q") else f"{name}_"
        out.update({f"{joint}{axis}": rows[:, k] for k, axis in enumerate(axes)})
    lengths = {name: len(np.atleast_1d(values)) for name, values in out.items()}
    if not lengths:
        raise InputError(f"{title}: has no columns; give {{column: values}} (docs/python.md).")
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {count}" for name, count in lengths.items())
        raise InputError(f"{title}: the columns have different lengths ({listed}).")
    return out


def _meaning(title: str, column: str, units: Mapping[str, Any]) -> tuple[str, float]:
    """Return (column, factor) of a column by its unit, or by that of its vector."""
    own = units.get(title)
    known = own if isinstance(own, Mapping) else units
    vector = column.removesuffix(column[-1:]).removesuffix("_")
    unit = known.get(column, known.get(vector))
    return parse_column(title, column, column if unit is None else f"{column}:{unit}")


def _numbers(title: str, name: str, values: Any) -> np.ndarray:
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{title}: {name} holds values that are no numbers ({error}).") from error
