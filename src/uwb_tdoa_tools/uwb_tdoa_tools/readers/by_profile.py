# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Read recordings of others by a Profile: bags of ROS 1 and ROS 2, CSV files, ULog."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
import re
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.survey import Entry, name_of, refuse_faulty

from ..bags import is_bag, is_ros_1
from .names import NamedAnchors, named_anchors
from .profile import (
    ANCHORS,
    ATTITUDE,
    EMPTY,
    MOST_SKIPPED,
    RADIO,
    STREAMS,
    Columns,
    Profile,
    Source,
    parts_of,
    time_column,
)
from .streams import Streams, by_time, make_flight
from .tables import CsvFiles, ULogFile, is_ulog, table_of

SURVEY = "anchors"  # stream of positions
SINGLE = "gyro", "acc", "pose", "tof", "baro", "flow"  # streams of one sensor each
MOST_LISTED = 8  # columns in a sentence
THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")  # as 1,000
MOVED = 0.1  # m that the recorded position of an anchor changes, above which it is reported
_MOMENT = re.compile(
    r"(?=\d)(?:(\d{4})[-/](\d\d?)[-/](\d\d?))?[T ]*(?:(\d\d?):(\d\d):(\d\d(?:[.,]\d+)?))?"
    r"\s*(?:Z|UTC|([-+]\d\d):?(\d\d))?"
)
ENU_OF_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU_OF_FRD = np.diag([1.0, -1.0, -1.0])


class Record(Protocol):
    """A message, or a row of a table.

    A `path` names a field of a message, as "pose.x", or a column.
    """

    def length(self, path: str) -> int:
        """Return the length of an array. Raises KeyError."""

    def value(self, path: str, index: int | None = None) -> Any:
        """Return the value of a field. Raises KeyError; IndexError where an array is shorter."""


class Foreign(Protocol):
    """Tables of a recording: topics of a bag, CSV files, messages of a ULog.

    Attributes
    ----------
    types : {table: type}.
    counts : {table: messages}.
    remarks : sentences on what is missing, after reading.
    """

    types: dict[str, str]
    counts: Counter[str]
    remarks: list[str]

    def fields(self, table: str) -> list[str]:
        """Return the fields of a table."""

    def time_of(self, table: str) -> tuple[str, float] | None:
        """Return the field with the time and its unit in s, if tables of this kind have one."""

    def messages(self, tables: Sequence[str]) -> Iterator[tuple[str, str, Record]]:
        """Yield (table, place in its file for messages to the user, Record)."""


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
        from ..bags.foreign import open_foreign  # only bags need the rosbags library

        with open_foreign(bags, types or {}) as bag:
            yield bag
    elif is_ulog(files[0]):
        yield ULogFile(files, salvage)
    else:
        yield CsvFiles(files)


def files_of(paths: Sequence[Path]) -> list[Path]:
    """Return the files of a recording; those in a folder belong together. Raises InputError."""
    found: list[Path] = []
    for path in paths:
        if not path.exists():
            raise InputError(f"{path}: does not exist; give a recording.")
        if path.is_dir() and not is_bag(path):
            inside = [each for each in sorted(path.iterdir()) if _may_be_recording(each)]
            if not inside:
                raise InputError(f"{path}: holds no CSV file, bag or ULog; give a recording.")
            found += inside
        else:
            found.append(path)
    return found


def _may_be_recording(path: Path) -> bool:
    return path.name.endswith((".csv", ".csv.gz", ".bag", ".ulg")) or is_bag(path)


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
        remarks: list[str] = []
        requests = _requests(tables, profile, files[0], namespace, remarks)
        named = survey or _recorded_anchors(tables, requests, files[0], remarks)
        _take(tables, [one for one in requests if one.gives != {SURVEY}], named, tag)
        streams: Streams = {}
        parts: dict[str, list[tuple[str, dict[str, np.ndarray]]]] = {}
        for request in requests:
            for stream, columns in request.streams(remarks, salvage).items():
                parts.setdefault(stream, []).append((request.table, columns))
        _check_tag(files[0], requests, tag)
        for stream, found in parts.items():
            if stream in SINGLE and len(found) > 1:
                raise InputError(
                    f"{files[0]}: {' and '.join(table for table, _ in found)} both give {stream}, which is of one "
                    "sensor; leave one of them out of the profile."
                )
            if isinstance(tables, CsvFiles) and not any(source.topic for source in profile.sources):
                _refuse_same_anchors(found)
            streams[stream] = _joined([columns for _, columns in found])
        remarks += tables.remarks
        meta: dict[str, Any] = {
            "source": ", ".join(map(str, paths)),
            "format": profile.name,
            "remarks": remarks,
            "read": [sentence for request in requests for sentence in request.sentences()],
            "unread": _unread(tables, requests),
        }
    antenna = profile.antenna.get(tag) or profile.antenna.get("")
    if antenna:
        meta["antenna"] = list(antenna)
    if named.ids:
        meta["anchor_ids"] = named.ids
    for ids in (streams.get("tdoa", {}), streams.get("range", {})):
        ids.update({name: ids[name].astype(np.int64) for name in ids.keys() & {"a", "b", "anchor"}})
    name = _name(files[0]) + (f"_tag{tag}" if tag else "")
    return make_flight(name, named.anchors, streams, {}, meta, salvage, truth)


def _name(path: Path) -> str:
    stem = path.name.removesuffix(".gz")
    return Path(stem).stem if path.is_file() else stem


class _Request:
    """The streams of one source in one table, and the records read so far.

    Attributes
    ----------
    gives : names of the streams of the source.
    tags : {tag: records}.
    positions : {name of an anchor: position, m, in the axes of the source}.
    moved : {name of an anchor: largest change of a coordinate, m}.
    unstamped : messages without a stamp.
    """

    def __init__(
        self,
        table: str,
        source: Source,
        names: dict[str, str],
        tables: Foreign,
        held: bool = False,
    ) -> None:
        """Prepare to read a source of a table.

        names : {name in a pattern: text}; held : leave out records that repeat the last one.
        """
        self.table, self.source, self._names, self._held = table, source, names, held
        self._fields = tables.fields(table)
        # Then a comma in a cell may be a thousands separator.
        self._between_commas = isinstance(tables, CsvFiles) and tables.delimiters[table] == ","
        default = tables.time_of(table)
        self._wanted = _wanted(source, default)
        self.gives = {*self._wanted}
        if any("t" not in mine for stream, mine in self._wanted.items() if stream != SURVEY):
            raise InputError(
                f"{table}: the profile names no column with the time; write time: COLUMN."
            )
        self._values: dict[str, dict[str, array[float]]] = {
            stream: {name: array("d") for name in mine} for stream, mine in self._wanted.items()
        }
        times = [mine["t"][0] for mine in self._wanted.values() if "t" in mine]
        self._sums = {path: parts_of(path) for path in times if len(parts_of(path)) > 1}
        self._first: dict[str, str] = {}
        self._skipped: Counter[str] = Counter()
        self.tags: Counter[str] = Counter()
        self.positions: dict[str, tuple[float, float, float]] = {}
        self.moved: dict[str, float] = {}
        self._left_out = 0
        self.unstamped = self._repeats = 0
        self._last: list[Any] = []
        self._by_stamp = default is not None and any(
            mine.get("t") == default for mine in self._wanted.values()
        )

    def take(self, record: Record, place: str, named: NamedAnchors | None, tag: str) -> None:
        """Add the records of a message; with `named` None only positions of anchors."""
        each = self.source.each
        try:
            for index in range(record.length(each)) if each else (None,):
                self._take_one(record, index, place, named, tag)
        except KeyError as error:
            raise InputError(
                f"{self.table}: has no field {error.args[0]!r}; its fields are "
                f"{', '.join(self._fields)}."
            ) from error

    def _take_one(
        self, record: Record, index: int | None, place: str, named: NamedAnchors | None, tag: str
    ) -> None:
        def value(path: str) -> Any:
            if path in self._sums:
                times = [(as_time(record.value(part, index)), f) for part, f in self._sums[path]]
                known = [t * f for t, f in times if t is not None]
                return sum(known) if len(known) == len(times) else ""
            return self._names[path] if path in self._names else record.value(path, index)

        if not all(condition.met(value(condition.path)) for condition in self.source.where):
            self._left_out += named is not None
            return
        if named is None:
            self._take_anchor(value, place)
            return
        if self.source.tag:
            of = name_of(value(self.source.tag))
            self.tags[of] += 1
            if tag and of != tag:
                return
        for stream, mine in self._wanted.items():
            if stream == SURVEY:
                continue
            raw: dict[str, Any] = {}
            for name, (path, _) in mine.items():
                try:
                    raw[name] = value(path)
                except IndexError:
                    raw[name] = ""
            values = [each for name, each in raw.items() if name != "t"]
            if all(isinstance(each, str) and each.lower() in EMPTY for each in values):
                continue
            if self._held and values == self._last:
                self._repeats += 1
                continue
            self._last = values
            self._keep(stream, raw, place, named)

    def _keep(self, stream: str, raw: dict[str, Any], place: str, named: NamedAnchors) -> None:
        record = {
            name: (
                named.id_of(each)
                if name in ANCHORS
                else as_time(each)
                if name == "t"
                else self._number(each, self._wanted[stream][name][0], place)
            )
            for name, each in raw.items()
        }
        wrong = next((name for name, number in record.items() if number is None), None)
        if wrong is None:
            for name, number in record.items():
                self._values[stream][name].append(number)  # type: ignore[arg-type]  # none is None
            return
        self._skipped[stream] += 1
        what = (
            "an anchor of the survey, by its name, or an id 0 ... 65535"
            if wrong in ANCHORS
            else "a finite number"
        )
        column = self._wanted[stream][wrong][0]
        self._first.setdefault(
            stream, f"{place}: {column} is {str(raw[wrong])[:40]!r}; it must be {what}"
        )

    def _number(self, value: Any, column: str, place: str) -> float | None:
        """Return `as_number`; raise InputError if a comma may be a thousands separator."""
        if self._between_commas and isinstance(value, str) and THOUSANDS.fullmatch(value):
            raise InputError(
                f"{self.table}: {place}: {column} is {value!r}, with a thousands separator or a "
                "decimal comma; write a decimal point, or put semicolons between the cells."
            )
        return as_number(value)

    def _take_anchor(self, value: Callable[[str], Any], place: str) -> None:
        """Store the position of an anchor, and by how much it differs from the one before.

        `value` returns the value of the record at a path.
        """
        paths = [self._wanted[SURVEY][name][0] for name in STREAMS[SURVEY]]
        anchor = value(paths[0])
        numbers = [self._number(value(path), path, place) for path in paths[1:]]
        if None in numbers:
            return
        factors = [self._wanted[SURVEY][f"anchor_{axis}"][1] for axis in "xyz"]
        at = [each * factor for each, factor in zip(numbers, factors) if each is not None]
        name = name_of(anchor)
        last = self.positions.get(name)
        if last is not None and not any(at):
            return  # drivers write zeros where they do not know the position
        if last is not None and any(last):
            shift = float(np.abs(np.subtract(at, last)).max())
            self.moved[name] = max(self.moved.get(name, 0.0), shift)
        self.positions[name] = (at[0], at[1], at[2])

    def surveyed(self) -> dict[str, np.ndarray]:
        """Return {name of an anchor: (3,) m} in our axes."""
        turned = _axes_of_world(self.source)
        return {name: turned @ np.array(place) for name, place in self.positions.items()}

    def streams(self, remarks: list[str], salvage: bool) -> Streams:
        """Return {stream: {column: (n,) array}} in the units of `make_flight`.

        Raises InputError for more than MOST_SKIPPED invalid records.
        """
        out: Streams = {}
        for stream, count in self._skipped.items():
            n = count + len(self._values[stream]["t"])
            names = ", ".join(name for name in self._wanted[stream] if name != "t")
            if count > MOST_SKIPPED * n and not salvage:
                raise InputError(
                    f"{self.table}: {self._first[stream]} ({count} of {n} records of {names} are "
                    "like that: more than a gap)."
                )
            remarks.append(f"{self.table}: {count} of {n} records left out, {self._first[stream]}.")
        for stream, values in self._values.items():
            if stream != SURVEY and len(values["t"]):
                arrays = {
                    name: np.array(column) * self._wanted[stream][name][1]
                    for name, column in values.items()
                }
                out[stream] = _in_our_axes(stream, arrays, self.source)
        return out

    def sentences(self) -> Iterator[str]:
        """Yield what was read, with counts and seconds."""
        of = self._names.values() if self._held else ()
        for stream, values in self._values.items():
            if stream == SURVEY:
                if self.positions:
                    yield f"{self.table}: positions of {len(self.positions)} anchors"
                continue
            t = np.array(values["t"]) * self._wanted[stream]["t"][1]
            span = f", {t.min():.1f} to {t.max():.1f} s" if len(t) else ""
            yield f"{self.table}: {len(t)} records of {' '.join([stream, *of])}{span}"
        if self._repeats:
            yield f"{self.table}: {self._repeats} values of {' '.join(of)} repeat the last one"
        if self.unstamped and self._by_stamp:
            yield f"{self.table}: {self.unstamped} messages without a stamp: the time of recording counts"
        if self._left_out:
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
    if stream == "pose":
        turned = _axes_of_world(source)
        place = np.stack([out[axis] for axis in "xyz"])
        out.update(zip("xyz", turned @ place))
        if ATTITUDE <= arrays.keys():
            q = np.stack([out[f"q{k}"] for k in "xyzw"], axis=1)
            known = np.isfinite(q).all(axis=1) & (np.abs(q).max(axis=1) > 0.0)
            body = FLU_OF_FRD if source.body == "frd" else np.eye(3)
            safe = np.where(known[:, None], q, [0.0, 0.0, 0.0, 1.0])
            matrices = turned @ Rotation.from_quat(safe).as_matrix() @ body
            ours = Rotation.from_matrix(matrices).as_quat()
            changed = source.world == "ned" or source.body == "frd"
            q = np.where(known[:, None], ours if changed else q, np.nan)
            out.update(zip((f"q{k}" for k in "xyzw"), q.T))
    return out


def _axes_of_world(source: Source) -> np.ndarray:
    """Return the rotation (3, 3) from the world axes of a Source to ours."""
    return ENU_OF_NED if source.world == "ned" else np.eye(3)


def _requests(
    tables: Foreign, profile: Profile, path: Path, namespace: str, remarks: list[str]
) -> list[_Request]:
    """Return the requests of all sources. Raises InputError."""
    requests = []
    for number, source in enumerate(profile.sources, start=1):
        found: dict[str, dict[str, str]] = {}
        if isinstance(tables, CsvFiles) and not source.topic:
            found = {table: {} for table in _csv_with_columns(tables, source)}
        else:
            for table, kind in tables.types.items() if source.topic or source.type else ():
                name = table_of(table) if isinstance(tables, CsvFiles) else table
                names = source.match(name, kind)
                if names is not None:
                    found[table] = names
            if not found:
                what = source.topic or source.type
                remarks.append(f"the recording has no {what}, source {number} of the profile.")
            if len(found) > 1 and not any(found.values()):
                found = _in_namespace(path, found, namespace)
        requests += [
            _Request(table, one, names | more, tables, bool(more))
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
    path: Path, found: dict[str, dict[str, str]], namespace: str
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


def _paths(source: Source) -> set[str]:
    """Return the columns that are read, also to decide which records count."""
    paths = {path for mine in _wanted(source).values() for path, _ in mine.values()}
    return {part for path in paths for part, _ in parts_of(path)} | source.conditions


def _wanted(source: Source, default: tuple[str, float] | None = None) -> dict[str, Columns]:
    """Return {stream: columns of a source, "t" with the time, or with `default` if it has none}."""
    wanted: dict[str, Columns] = {}
    for stream, known in STREAMS.items():
        mine = {name: source.columns[name] for name in known if name in source.columns}
        time = time_column(stream, source.columns) or default
        if mine:
            wanted[stream] = mine | ({"t": time} if time and stream != SURVEY else {})
    return wanted


def _take(
    tables: Foreign, requests: Sequence[_Request], named: NamedAnchors | None, tag: str
) -> None:
    by_table: dict[str, list[_Request]] = {}
    for request in requests:
        by_table.setdefault(request.table, []).append(request)
    for table, place, record in tables.messages([*by_table]):
        for request in by_table[table]:
            request.take(record, place, named, tag)
            request.unstamped += not getattr(record, "is_stamped", True)


def _recorded_anchors(
    tables: Foreign, requests: Sequence[_Request], path: Path, remarks: list[str]
) -> NamedAnchors:
    """Return the anchors in the recording. Raises InputError."""
    sources = [request for request in requests if SURVEY in request.gives]
    _take(tables, sources, None, "")
    places: dict[str, np.ndarray] = {}
    for request in sources:
        places |= request.surveyed()
        remarks += [
            f"{request.table}: the position of anchor {name} changes by {shift:.2f} m; the last "
            "one counts."
            for name, shift in request.moved.items()
            if shift > MOVED
        ]
    if places:
        entries = [
            Entry(name, list(place), [np.nan] * 4, f"anchor {name}")
            for name, place in places.items()
        ]
        named = named_anchors(path, entries, "map")
        refuse_faulty(named.anchors, str(path))
        return named
    recorded = getattr(tables, "recorded_anchors", lambda: None)()
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


def _check_tag(path: Path, requests: Sequence[_Request], tag: str) -> None:
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
    try:
        number = float(value.replace(",", ".") if isinstance(value, str) else value)
    except (TypeError, ValueError):
        return None
    return number if np.isfinite(number) else None
