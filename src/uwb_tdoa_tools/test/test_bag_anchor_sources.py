"""Anchors of a bag that has no uwb/anchors: frames of /tf_static, and markers."""

import numpy as np
import pytest
from recordings import small_flight
from test_bag import write_topics

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_tools.bags.bag import read_bag
from uwb_tdoa_tools.bags.message_types import typestore
from uwb_tdoa_tools.bags.messages import header_of, pose_of, tdoa_messages, transforms_message

MARKERS, TRANSFORMS = "visualization_msgs/msg/MarkerArray", "tf2_msgs/msg/TFMessage"
PLACES = [[0.0, 0.0, 1.0], [5.0, 0.0, 2.0], [5.0, 4.0, 1.5], [0.0, 4.0, 2.5], [2.0, 2.0, 3.0]]
ANCHORS = Anchors.from_positions(PLACES, [3, 4, 5, 8, 9], "room")
CUBE, TEXT, ADD, DELETE = 1, 9, 0, 2


def tdoas():
    return (
        "/uwb/tdoa",
        "uwb_tdoa_msgs/msg/Tdoa",
        list(tdoa_messages(small_flight(0.05).tdoa, typestore())),
    )


def marker(number, place, kind=CUBE, action=ADD, frame="hall", name="anchors"):
    store = typestore()
    Vector, Color = store.types["geometry_msgs/msg/Vector3"], store.types["std_msgs/msg/ColorRGBA"]
    Image, Mesh = (
        store.types["sensor_msgs/msg/CompressedImage"],
        store.types["visualization_msgs/msg/MeshFile"],
    )
    time, header = store.types["builtin_interfaces/msg/Duration"](0, 0), header_of(store, 5, frame)
    empty = np.zeros(0, np.uint8)
    return store.types["visualization_msgs/msg/Marker"](
        header,
        name,
        number,
        kind,
        action,
        pose_of(store, place),
        Vector(0.1, 0.1, 0.1),
        Color(1.0, 0.0, 0.0, 1.0),
        time,
        False,
        [],
        [],
        "",
        Image(header, "", empty),
        [],
        "",
        "",
        Mesh("", empty),
        False,
    )


def markers(*parts):
    return [(5, typestore().types[MARKERS](list(parts)))]


def test_frames_of_tf_static_are_anchors(tmp_path):
    write_topics(
        tmp_path / "bag",
        tdoas(),
        ("/tf_static", TRANSFORMS, [transforms_message(ANCHORS, 5, typestore())]),
    )
    back = read_bag(tmp_path / "bag")
    np.testing.assert_array_equal(back.anchors.ids, ANCHORS.ids)
    np.testing.assert_array_equal(back.anchors.positions, ANCHORS.positions)
    assert back.anchors.frame == ANCHORS.frame
    assert (
        f"there is no /uwb/anchors: the {len(ANCHORS)} anchors are those of /tf_static."
        in back.meta["remarks"]
    )


def test_markers_of_anchors_are_anchors(tmp_path):
    """Beside their labels, others that have been deleted, and markers of something else."""
    places = list(zip(ANCHORS.ids.tolist(), ANCHORS.positions.tolist()))
    cubes = [marker(number, place) for number, place in places]
    others = [marker(number, (9.0, 9.0, 9.0), TEXT) for number, _ in places]
    others += [
        marker(900, (8.0, 8.0, 8.0), action=DELETE),
        marker(901, (1.0, 1.0, 1.0), name="walls"),
    ]
    write_topics(tmp_path / "bag", tdoas(), ("/show", MARKERS, markers(*cubes, *others)))
    back = read_bag(tmp_path / "bag")
    np.testing.assert_array_equal(back.anchors.ids, ANCHORS.ids)
    np.testing.assert_array_equal(back.anchors.positions, ANCHORS.positions)
    assert back.anchors.frame == "hall" and "/show" in " ".join(back.meta["remarks"])


@pytest.mark.parametrize("name, count", [("robots", len(ANCHORS)), ("anchors", 3)])
def test_what_may_be_something_else_is_none(tmp_path, name, count):
    cubes = [
        marker(k, place, name=name) for k, place in enumerate(ANCHORS.positions.tolist()[:count])
    ]
    write_topics(tmp_path / "bag", tdoas(), ("/show", MARKERS, markers(*cubes)))
    with pytest.raises(InputError, match="no message on /uwb/anchors; give a survey file"):
        read_bag(tmp_path / "bag")
