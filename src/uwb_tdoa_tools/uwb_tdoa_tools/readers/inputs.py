"""From the paths on a command line to flights: files or folders of recordings, one survey or a folder of them."""

from pathlib import Path

from tqdm import tqdm

from uwb_tdoa_bias.foundation.errors import InputError

from . import read_flight

HELP = "recordings: raw logs, UTIL CSV files, bags, or folders that hold them"
SURVEY_HELP = (
    "anchor survey (total station .txt, const .csv or anchors .yaml), or a folder of them: then anchor_KEY.* serves "
    "the recordings whose path contains KEY; bags carry their own"
)


def find_flights(paths, survey=None, absolute=False):
    """Pairs (recording, survey or None), sorted within each folder. Raises InputError where nothing, or no one survey,
    fits.

    absolute : make them absolute paths, for processes that may have another working directory.
    """
    found = []
    for path in map(Path, paths):
        if not path.exists():
            raise InputError(f"{path}: does not exist; give a recording or a folder that holds recordings.")
        inside = list(_recordings(path))
        if not inside:
            raise InputError(f"{path}: holds no recording; expected logs, CSV files or bags.")
        found += inside
    pairs = [(path, None if _is_bag(path) else survey_for(path, survey)) for path in found]
    if absolute:
        pairs = [(path.absolute(), its_survey and Path(its_survey).absolute()) for path, its_survey in pairs]
    return pairs


def survey_for(path, survey):
    """The survey of a recording: `survey` itself, or out of a folder the one whose KEY is the longest in the path."""
    if survey is None or not Path(survey).is_dir():
        return survey
    keys = {file.stem.removeprefix("anchor_"): file for file in sorted(Path(survey).glob("anchor_?*"))}
    name = str(Path(path).resolve())
    fitting = sorted((key for key in keys if key in name), key=lambda key: (name.rfind(key) + len(key), len(key)))
    if not fitting:
        raise InputError(f"{path}: no survey in {survey} fits: its path holds none of {', '.join(keys)}.")
    return keys[fitting[-1]]


def load_flights(paths, survey=None):
    """Read them one by one: a generator of Flight."""
    for path, its_survey in find_flights(paths, survey):
        yield read_flight(path, its_survey)


def _is_bag(path):
    return path.suffix in (".mcap", ".db3") or (path / "metadata.yaml").exists()


def _recordings(path):
    if path.is_file() or _is_bag(path):
        yield path
        return
    for inside in sorted(path.iterdir()):
        if not inside.name.startswith("."):
            yield from _recordings(inside)


def read_flights(paths, survey, namespace=""):
    """Flights of recordings, with a progress bar: list. namespace : of the topics in bags. Raises InputError."""
    found = find_flights(paths, survey)
    found = tqdm(found, desc="reading", unit="flight", disable=None, leave=False)
    return [read_flight(*recording, namespace) for recording in found]
