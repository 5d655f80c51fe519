# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Intact bags whose metadata.yaml is lost or does not match the files. The files count."""

import re
import shutil

import pytest
from recordings import differences, small_flight

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools.bags import is_bag
from uwb_tdoa_tools.bags.bag import read_bag, write_bag
from uwb_tdoa_tools.bags.mcap import zstd
from uwb_tdoa_tools.readers.inputs import find_flights

FLIGHT = small_flight(0.2, name="bag")


@pytest.fixture(params=["mcap", "sqlite3"])
def bag(request, tmp_path):
    write_bag(FLIGHT, tmp_path / "bag", request.param)
    return tmp_path / "bag"


def data_file(bag):
    (file,) = (file for file in bag.iterdir() if file.name != "metadata.yaml")
    return file


def edit(bag, old, new):
    text = (bag / "metadata.yaml").read_text()
    assert re.search(old, text)
    (bag / "metadata.yaml").write_text(re.sub(old, new, text))


def pack(file):
    packed = file.with_name(f"{file.name}.zstd")
    packed.write_bytes(zstd.compress(file.read_bytes()))
    file.unlink()
    return packed


def without_identifier(bag):
    edit(bag, "storage_identifier: .*", "storage_identifier: ''")
    return bag


def with_an_unknown_identifier(bag):
    edit(bag, "storage_identifier: .*", "storage_identifier: my_storage_plugin")
    return bag


def renamed(bag):
    data_file(bag).rename(bag / "before lunch")
    return bag


def without_metadata(bag):
    (bag / "metadata.yaml").unlink()
    return bag


def unpacked_by_hand(bag):
    name = data_file(bag).name
    edit(bag, re.escape(name), f"{name}.zstd")
    edit(bag, "compression_mode: .*", "compression_mode: FILE")
    edit(bag, "compression_format: .*", "compression_format: zstd")
    edit(bag, "  custom_data:", "  custom_data:\n    other: text")
    edit(bag, " *uwb_tdoa_tools.crc32: .*\n", "")
    return bag


def packed_by_hand(bag):
    pack(data_file(bag))
    return bag


def packed_without_metadata(bag):
    pack(data_file(bag))
    (bag / "metadata.yaml").unlink()
    return bag


def packed_file(bag):
    (bag / "metadata.yaml").unlink()
    return pack(data_file(bag))


def file_with_another_suffix(bag):
    return data_file(bag).rename(bag / "recording.2026")


FORMS = [
    without_identifier,
    with_an_unknown_identifier,
    renamed,
    without_metadata,
    unpacked_by_hand,
    packed_by_hand,
    packed_without_metadata,
    packed_file,
    file_with_another_suffix,
]


@pytest.mark.parametrize("form", FORMS)
def test_a_sound_bag_is_read_and_left_as_it_is(bag, form):
    given = form(bag)
    before = {file.name: file.read_bytes() for file in bag.iterdir()}
    assert is_bag(given)
    flight = read_bag(given)
    assert differences(FLIGHT, flight) == []
    assert {file.name: file.read_bytes() for file in bag.iterdir()} == before
    if given.is_dir():
        assert any("metadata.yaml" in remark for remark in flight.meta["remarks"])


@pytest.mark.parametrize("form", FORMS)
def test_what_is_missing_in_such_a_bag_is_not_passed_over(bag, form):
    """The same, with a truncated data file."""
    given = form(bag)
    files = [file for file in bag.iterdir() if file.name != "metadata.yaml"]
    files[0].write_bytes(files[0].read_bytes()[:-300])
    with pytest.raises(InputError, match="cut or damaged"):
        read_bag(given)


def test_a_file_that_is_not_there_is_named(bag):
    file = data_file(bag)
    file.unlink()
    with pytest.raises(InputError, match=f"{re.escape(file.name)} is missing"):
        read_bag(bag)


def test_a_renamed_file_of_another_recording_is_refused(bag, tmp_path):
    """The checksum and the counts in metadata.yaml belong to the replaced file."""
    storage = "sqlite3" if data_file(bag).suffix == ".db3" else "mcap"
    write_bag(small_flight(0.1), tmp_path / "other", storage)
    data_file(bag).unlink()
    shutil.copy(data_file(tmp_path / "other"), bag / "renamed")
    with pytest.raises(InputError, match="checksum"):
        read_bag(bag)


def test_parts_without_metadata_are_one_recording(bag, tmp_path):
    """`ros2 bag record` splits a recording: NAME_0, NAME_1, ..., NAME_10. The last is NAME_10."""
    parts = tmp_path / "split"
    parts.mkdir()
    file = data_file(bag)
    for number in (0, 10, 2):
        shutil.copy(file, parts / f"split_{number}{file.suffix}")
    assert [path for path, _ in find_flights([tmp_path / "split"])] == [parts]
    assert len(read_bag(parts).tdoa) == 3 * len(FLIGHT.tdoa)
    shutil.copy(file, parts / f"another{file.suffix}")
    assert len(find_flights([parts])) == 4
