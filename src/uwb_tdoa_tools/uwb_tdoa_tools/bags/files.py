"""Bags as files: opening them, going through their messages, and making new ones that are never half-written."""

import shutil
import tempfile
from contextlib import contextmanager
from pathlib import Path

from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from uwb_tdoa_bias.foundation.errors import InputError

from .message_types import add_type, typestore

STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
_FILE_MAGIC = (b"\x89MCAP0\r\n", b"SQLite format 3\0")


@contextmanager
def new_bag(out, storage="mcap", force=False):
    """A rosbags Writer whose bag appears at `out` only if the block ends without an exception."""
    out = Path(out)
    if storage not in STORAGES:
        raise InputError(f"storage: {storage!r} is not known; choose one of {', '.join(STORAGES)}.")
    check_output(out, force)
    out.parent.mkdir(parents=True, exist_ok=True)
    # A sibling, so that the last step is a rename. In it the bag's own name: rosbags names the data file after it.
    scratch = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".partial", dir=out.parent))
    try:
        with Writer(scratch / out.name, version=Writer.VERSION_LATEST, storage_plugin=STORAGES[storage]) as writer:
            yield writer
        if out.exists():
            check_output(out, force)
            out.rename(scratch / "replaced")
        (scratch / out.name).rename(out)
    finally:
        shutil.rmtree(scratch)


def check_output(out, force=False):
    """Raise InputError if a new bag cannot be put at `out`: something is there that force may not replace."""
    out = Path(out)
    if not out.name:
        raise InputError(f"{out}: is no name for a bag; give the path of a new directory.")
    if not out.exists() and not out.is_symlink():
        return
    if not force:
        raise InputError(f"{out}: exists already; choose another name, or --force to replace it.")
    if out.is_symlink() or not (out / "metadata.yaml").is_file():
        raise InputError(f"{out}: exists and is not a bag, so --force does not replace it; choose another name.")


def is_bag(path):
    """Whether a path is meant as a bag: a directory with metadata.yaml, .mcap or .db3 files, or such a file."""
    path = Path(path)
    if path.is_dir():
        return any(path.glob("metadata.yaml")) or any(path.glob("*.mcap")) or any(path.glob("*.db3"))
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(16).startswith(_FILE_MAGIC)


@contextmanager
def open_bag(path):
    """An open rosbags Reader of a bag directory or data file; raises InputError with what is wrong with it."""
    path = Path(path)
    if not is_bag(path):
        raise InputError(f"{path}: is not a bag; give the directory with metadata.yaml or its .mcap or .db3 file.")
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise InputError(f"{path}: has no metadata.yaml: the recording was not closed; run `ros2 bag reindex` on it.")
    try:
        reader = Reader(path)
        reader.open()
    except Exception as error:  # rosbags raises whatever its parsers run into
        raise _damaged(path, error) from error
    try:
        yield reader
    finally:
        reader.close()


def messages(path, reader, connections):
    """Yield (connection, stamp ns, bytes) of the given connections in the bag's order; raises InputError."""
    found = reader.messages(connections=connections) if connections else iter(())
    while True:
        try:
            message = next(found)
        except StopIteration:
            return
        except Exception as error:  # as in open_bag
            raise _damaged(path, error) from error
        yield message


def deserialize(path, connection, data):
    """The message of (connection, bytes); raises InputError if the bytes are none."""
    try:
        return typestore().deserialize_cdr(data, connection.msgtype)
    except Exception as error:  # as in open_bag
        raise _damaged(path, error) from error


def check_type(path, connection):
    """Raise InputError unless we know the type of a topic, in the version in which it was recorded."""
    store = typestore()
    add_type(store, connection.msgtype)
    recorded = connection.digest
    if not recorded and connection.msgdef.format == MessageDefinitionFormat.MSG:  # a data file without metadata.yaml
        of_bag = get_typestore(Stores.EMPTY)
        of_bag.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        recorded = of_bag.hash_rihs01(connection.msgtype)
    if recorded and recorded != store.hash_rihs01(connection.msgtype):
        raise InputError(
            f"{path}: {connection.topic} was recorded with another version of {connection.msgtype}; use the version of "
            "this software that recorded it."
        )


def _damaged(path, error):
    said = str(error) or type(error).__name__
    return InputError(f"{path}: the bag is cut or damaged ({said}); copy it again, or record it again.")
