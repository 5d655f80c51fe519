# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import json
import os
from pathlib import Path

import pytest
from rosbags.typesys import Stores, get_typestore

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools.bags.messages import OUR_TYPES, add_type, typestore

PREFIXES = [
    Path(prefix) for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix
]
BUILT = [prefix / "share" / "uwb_tdoa_msgs" / "msg" for prefix in PREFIXES]


def test_our_types_are_all_messages_of_the_package():
    messages = Path(__file__).resolve().parents[2] / "uwb_tdoa_msgs" / "msg"
    assert sorted(OUR_TYPES) == sorted(file.stem for file in messages.glob("*.msg"))


@pytest.mark.parametrize("name", OUR_TYPES)
def test_type_hash_is_the_one_of_the_build(name):
    descriptions = [
        folder / f"{name}.json" for folder in BUILT if (folder / f"{name}.json").exists()
    ]
    if not descriptions:
        pytest.skip("uwb_tdoa_msgs is not built and sourced")
    hashes = {
        entry["type_name"]: entry["hash_string"]
        for entry in json.loads(descriptions[0].read_text())["type_hashes"]
    }
    msgtype = f"uwb_tdoa_msgs/msg/{name}"
    assert typestore().hash_rihs01(msgtype) == hashes[msgtype]


def test_installed_types_come_with_what_they_are_made_of(tmp_path, monkeypatch):
    share = tmp_path / "share"
    for package, name, text in (
        ("one_msgs", "Outer", "two_msgs/Inner[3] many\nstring name"),
        ("two_msgs", "Inner", "int8 x"),
    ):
        folder = share / package / "msg"
        folder.mkdir(parents=True)
        (folder / f"{name}.msg").write_text(text)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    store = get_typestore(Stores.EMPTY)
    add_type(store, "one_msgs/msg/Outer")
    assert {"one_msgs/msg/Outer", "two_msgs/msg/Inner"} <= set(store.fielddefs)
    with pytest.raises(InputError, match="none_msgs/msg/Nothing: its definition is not installed"):
        add_type(store, "none_msgs/msg/Nothing")
