# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recordings of other tools, written from a Flight.

Bags of ROS 1 and ROS 2 with their message types, CSV files, ULog. The message definitions here
follow the meaning of the fields.
"""

import csv
import gzip
import struct

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

BEGIN = 1_700_000_000 * 10**9  # ns, start of the recordings
TAG = 7
NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # of our world axes

NODE2 = "uint8 role\nuint8 id\nfloat32 dis\nfloat32 fp_rssi\nfloat32 rx_rssi\n"
INERTIA = "float32[3] imu_gyro_3d\nfloat32[3] imu_acc_3d\n"
FRAME = "uint8 role\nuint8 id\nuint32 local_time\nuint32 system_time\nfloat32 voltage\n"
PLACE = "float32[3] pos_3d\nfloat32[3] eop_3d\nfloat32[3] vel_3d\n"
ATTITUDE = "float32[3] angle_3d\nfloat32[4] quaternion\n"
DEFINITIONS = {
    "cf_msgs/msg/Tdoa": "std_msgs/Header header\nint32 idA\nint32 idB\nfloat32 data\n",
    "cf_msgs/msg/Gyro": "std_msgs/Header header\nfloat32 x\nfloat32 y\nfloat32 z\n",
    "cf_msgs/msg/Accel": "std_msgs/Header header\nfloat32 x\nfloat32 y\nfloat32 z\n",
    "nlink_parser/msg/LinktrackNode2": NODE2,
    "nlink_parser/msg/LinktrackNodeframe2": FRAME
    + PLACE
    + ATTITUDE
    + INERTIA
    + "LinktrackNode2[] nodes\n",
    "nlink_parser/msg/LinktrackNodeframe3": FRAME + "LinktrackNode2[] nodes\n",
    "nlink_parser/msg/LinktrackTagframe0": FRAME
    + PLACE
    + "float32[8] dis_arr\n"
    + ATTITUDE
    + INERTIA,
    "dwm1001_ros_interfaces/msg/Anchor": "string id\ngeometry_msgs/Point location\nfloat64 dist\n",
    "dwm1001_ros_interfaces/msg/UWBMeas": "dwm1001_ros_interfaces/Anchor[] measurements\n",
    "uwb_msgs/msg/TwoWayRangeStamped": "std_msgs/Header header\nfloat32 range_raw\nfloat32 range_corr\nfloat32 R\n"
    "uint32 UWB_ID1\nuint32 UWB_ID2\nuint8 type_ID1\nuint8 type_ID2\nbool LOS\n",
    "uwb_msgs/msg/TDOARangesStamped": "std_msgs/Header header\nfloat32[] vec_range_raw\nfloat32[] vec_range_corr\n"
    "float32 R\nuint32 UWB_ID1\nuint32[] vec_UWB_ID2\nuint8 type_ID1\nuint8[] vec_type_ID2\nbool[] vec_LOS\n",
    "px4_msgs/msg/SensorUwb": "uint64 timestamp\nuint16 mac\nuint16 mac_dest\nuint16 status\nfloat32 distance\n",
    "px4_msgs/msg/SensorCombined": "uint64 timestamp\nfloat32[3] gyro_rad\nfloat32[3] accelerometer_m_s2\n",
    "px4_msgs/msg/VehicleOdometry": "uint64 timestamp\nuint8 pose_frame\nfloat32[3] position\nfloat32[4] q\n",
    "fraunhofer_rtls_flare/msg/RTLSRange": "uint16 id\nfloat64 range\nuint8 ra\n",
    "fraunhofer_rtls_flare/msg/RTLSStick": "std_msgs/Header header\nuint16 id\nRTLSRange[] ranges\n",
    "fraunhofer_rtls_flare/msg/AnchorPosition": "uint16 id\ngeometry_msgs/Point position\n",
    "fraunhofer_rtls_flare/msg/Anchorlist": "AnchorPosition[] anchor\n",
}


def store_of(which):
    """Return a typestore of ROS with the DEFINITIONS."""
    store = get_typestore(which)
    for name, text in DEFINITIONS.items():
        package = name.split("/")[0]
        for other in DEFINITIONS:  # types of the same package are written without its name
            if other.startswith(f"{package}/"):
                short = other.rpartition("/")[2]
                text = text.replace(f"\n{short}[", f"\n{package}/{short}[")
                text = f"{package}/{text}" if text.startswith(f"{short}[") else text
        store.register(get_types_from_msg(text, name))
    return store


def message(store, kind, **values):
    """Return a message with some fields set. All other fields are zero."""
    filled = {}
    for name, (node, what) in store.fielddefs[kind][1]:
        if name in values:
            filled[name] = values[name]
        elif node == Nodetype.NAME:
            filled[name] = message(store, what)
        elif node == Nodetype.BASE:
            filled[name] = "" if what[0] == "string" else 0
        elif what[0][0] == Nodetype.NAME:
            filled[name] = []
        else:
            filled[name] = np.zeros(what[1], dtype=what[0][1][0].replace("bool", "bool_"))
    return store.types[kind](**filled)


def header(store, stamp, frame=""):
    """Return a std_msgs/Header with a stamp in ns."""
    time = message(store, "builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
    return message(store, "std_msgs/msg/Header", stamp=time, frame_id=frame)


def vector(store, kind, values):
    """Return a Point, Vector3 or Quaternion."""
    return message(store, f"geometry_msgs/msg/{kind}", **dict(zip("xyzw", map(float, values))))


def ns(t):
    """Return the stamps in ns of times in s."""
    return [BEGIN + round(1e9 * each) for each in t]


def write_ros_1(path, topics, compression=None, chunk=1 << 20):
    """Write {topic: (type, [(ns, message)])} as a bag of ROS 1, with chunks of so many bytes."""
    store = store_of(Stores.ROS1_NOETIC)
    writer = Ros1Writer(path)
    writer.chunk_threshold = chunk
    if compression:
        writer.set_compression(compression)
    with writer:
        for topic, (kind, messages) in topics(store).items():
            connection = writer.add_connection(topic, kind, typestore=store)
            for stamp, content in messages:
                writer.write(connection, stamp, store.serialize_ros1(content, kind))
    return path


def write_ros_2(path, topics, storage, compression=None, size=None):
    """Write {topic: (type, [(ns, message)])} as a bag of ROS 2."""
    store = store_of(Stores.ROS2_JAZZY)
    writer = Ros2Writer(path, version=9, storage_plugin=storage)
    if compression:
        writer.set_compression(*compression)
    with writer:
        for topic, (kind, messages) in topics(store).items():
            connection = writer.add_connection(topic, kind, typestore=store)
            for stamp, content in messages:
                writer.write(connection, stamp, store.serialize_cdr(content, kind))
    return path


def ranges_by_time(flight):
    """Return [(ns, [(anchor, m), ...])]: ranges grouped by approximately equal stamps."""
    parts = np.array_split(np.arange(len(flight.range)), len(flight.range) // 4)
    stamps = ns(flight.range.t)
    return [
        (stamps[rows[0]], [(int(flight.range.anchor[k]), float(flight.range.d[k])) for k in rows])
        for rows in parts
    ]


def cf_msgs(flight):
    """Return topics(store): messages as the scripts of the UTIL dataset convert a log."""

    def topics(store):
        def inertial(kind, values):
            return [
                (
                    stamp,
                    message(
                        store,
                        kind,
                        header=header(store, stamp, "imu"),
                        **dict(zip("xyz", map(float, row))),
                    ),
                )
                for stamp, row in zip(ns(flight.imu.t), values)
            ]

        tdoa = flight.tdoa
        tdoas = [
            (
                stamp,
                message(
                    store,
                    "cf_msgs/msg/Tdoa",
                    header=header(store, stamp),
                    idA=int(a),
                    idB=int(b),
                    data=float(d),
                ),
            )
            for stamp, a, b, d in zip(ns(tdoa.t), tdoa.a, tdoa.b, tdoa.d)
        ]
        poses = []
        for stamp, p, q in zip(ns(flight.truth.t), flight.truth.p, flight.truth.q):
            pose = message(
                store,
                "geometry_msgs/msg/Pose",
                position=vector(store, "Point", p),
                orientation=vector(store, "Quaternion", q),
            )
            inside = message(store, "geometry_msgs/msg/PoseWithCovariance", pose=pose)
            kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
            poses.append((stamp, message(store, kind, header=header(store, stamp), pose=inside)))
        return {
            "/tdoa_data": ("cf_msgs/msg/Tdoa", tdoas),
            "/gyro_data": (
                "cf_msgs/msg/Gyro",
                inertial("cf_msgs/msg/Gyro", np.rad2deg(flight.imu.gyro)),
            ),
            "/accel_data": (
                "cf_msgs/msg/Accel",
                inertial("cf_msgs/msg/Accel", flight.imu.accel / 9.81),
            ),
            "/pose_data": ("geometry_msgs/msg/PoseWithCovarianceStamped", poses),
        }

    return topics


def linktrack(flight, frame):
    """Return topics(store): frames of a tag without stamps, as nlink_parser publishes them."""
    kind = f"nlink_parser/msg/Linktrack{frame.capitalize()}"

    def topics(store):
        messages = []
        for stamp, heard in ranges_by_time(flight):
            if frame == "tagframe0":
                places = np.zeros(8, dtype=np.float32)
                for anchor, d in heard:
                    places[anchor] = d
                content = message(store, kind, id=TAG, dis_arr=places)
            else:
                nodes = [
                    message(store, "nlink_parser/msg/LinktrackNode2", role=1, id=anchor, dis=d)
                    for anchor, d in heard
                ]
                content = message(store, kind, id=TAG, nodes=nodes)
            messages.append((stamp, content))
        return {f"/nlink_linktrack_{frame}": (kind, messages)}

    return topics


def dwm1001_topics(flight, tags=("7",)):
    """Return topics(store) of a driver with one topic for each pair of a tag and an anchor."""

    def topics(store):
        found, kind = {}, "std_msgs/msg/Float64"
        for stamp, anchor, d in zip(ns(flight.range.t), flight.range.anchor, flight.range.d):
            for tag in tags:
                topic = f"/dwm1001/tag/{tag}/to/anchor/DW{anchor:02d}/distance"
                found.setdefault(topic, (kind, []))[1].append(
                    (stamp, message(store, kind, data=float(d)))
                )
        for anchor, p in zip(flight.anchors.ids, flight.anchors.positions):
            pose = message(store, "geometry_msgs/msg/Pose", position=vector(store, "Point", p))
            content = message(store, "geometry_msgs/msg/PoseStamped", pose=pose)
            found[f"/dwm1001/anchor/DW{anchor:02d}/position"] = (
                "geometry_msgs/msg/PoseStamped",
                [(BEGIN, content)],
            )
        return found

    return topics


def dwm1001_arrays(flight):
    """Return topics(store) of a driver that publishes all distances of one shell line.

    Ids have four hexadecimal digits.
    """
    kind, inner = "dwm1001_ros_interfaces/msg/UWBMeas", "dwm1001_ros_interfaces/msg/Anchor"

    def topics(store):
        messages = []
        for stamp, heard in ranges_by_time(flight):
            entries = [
                message(
                    store,
                    inner,
                    id=f"C2F{anchor}",
                    location=vector(store, "Point", flight.anchors.positions[anchor]),
                    dist=d,
                )
                for anchor, d in heard
            ]
            messages.append((stamp, message(store, kind, measurements=entries)))
        return {"/uwb/ID_5722/distances": (kind, messages)}

    return topics


def two_way_ranges(flight):
    """Return topics(store): uwb_msgs/TwoWayRangeStamped of a tag."""
    kind = "uwb_msgs/msg/TwoWayRangeStamped"

    def topics(store):
        messages = [
            (
                stamp,
                message(
                    store,
                    kind,
                    header=header(store, stamp),
                    range_raw=float(d),
                    UWB_ID1=TAG,
                    UWB_ID2=int(anchor),
                ),
            )
            for stamp, anchor, d in zip(ns(flight.range.t), flight.range.anchor, flight.range.d)
        ]
        return {"/tag/twr": (kind, messages)}

    return topics


def tdoa_arrays(flight):
    """Return topics(store): uwb_msgs/TDOARangesStamped.

    Each holds one TDOA against the first anchor of the pair.
    """
    kind = "uwb_msgs/msg/TDOARangesStamped"

    def topics(store):
        tdoa = flight.tdoa
        messages = [
            (
                stamp,
                message(
                    store,
                    kind,
                    header=header(store, stamp),
                    UWB_ID1=int(a),
                    vec_UWB_ID2=np.array([b], dtype=np.uint32),
                    vec_range_raw=np.array([d], dtype=np.float32),
                ),
            )
            for stamp, a, b, d in zip(ns(tdoa.t), tdoa.a, tdoa.b, tdoa.d)
        ]
        return {"/tag/tdoa": (kind, messages)}

    return topics


def ned(p):
    """Return positions (n, 3) as north, east, down."""
    return np.stack([p[:, 1], p[:, 0], -p[:, 2]], axis=1)


def frd(vectors):
    """Return vectors (n, 3) in a body frame forward, right, down."""
    return vectors * [1.0, -1.0, -1.0]


def ned_of_frd(q):
    """Convert attitudes of FLU in ENU, x y z w, to FRD in NED, w x y z; (n, 4)."""
    x, y, z, w = q.T
    half = np.sqrt(
        0.5
    )  # Hamilton products with (0, half, half, 0) from the left and (0, 1, 0, 0) from the right
    a = np.stack([-half * (x + y), half * (w + z), half * (w - z), half * (y - x)])
    return np.stack([-a[1], a[0], a[3], -a[2]], axis=1)


def px4_bag(flight):
    """Return topics(store) of px4_msgs, stamped in us since the start of the autopilot."""

    def topics(store):
        def rows(kind, t, **columns):
            return [
                (
                    BEGIN + round(1e9 * at),
                    message(
                        store,
                        kind,
                        timestamp=round(1e6 * at),
                        **{
                            name: np.float32(values[k]) if np.ndim(values[k]) else values[k].item()
                            for name, values in columns.items()
                        },
                    ),
                )
                for k, at in enumerate(t)
            ]

        uwb, imu, pose = (
            f"px4_msgs/msg/{name}" for name in ("SensorUwb", "SensorCombined", "VehicleOdometry")
        )
        return {
            "/fmu/out/sensor_uwb": (
                uwb,
                rows(uwb, flight.range.t, mac_dest=flight.range.anchor, distance=flight.range.d),
            ),
            "/fmu/out/sensor_combined": (
                imu,
                rows(
                    imu,
                    flight.imu.t,
                    gyro_rad=frd(flight.imu.gyro),
                    accelerometer_m_s2=frd(flight.imu.accel),
                ),
            ),
            "/fmu/out/vehicle_mocap_odometry": (
                pose,
                rows(
                    pose, flight.truth.t, position=ned(flight.truth.p), q=ned_of_frd(flight.truth.q)
                ),
            ),
        }

    return topics


def write_ulog(path, flight):
    """Write the same as `px4_bag` as a ULog (docs.px4.io, ULog file format)."""
    tables = [
        (
            "sensor_uwb",
            "uint64_t timestamp;uint16_t mac_dest;uint8_t[2] _padding0;float distance;",
            "<QH2xf",
            zip(flight.range.t, flight.range.anchor, flight.range.d),
        ),
        (
            "sensor_combined",
            "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;",
            "<Q6f",
            zip(flight.imu.t, *frd(flight.imu.gyro).T, *frd(flight.imu.accel).T),
        ),
        (
            "vehicle_mocap_odometry",
            "uint64_t timestamp;float[3] position;float[4] q;",
            "<Q7f",
            zip(flight.truth.t, *ned(flight.truth.p).T, *ned_of_frd(flight.truth.q).T),
        ),
    ]
    out = bytearray(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0))

    def add(kind, content):
        out.extend(struct.pack("<HB", len(content), ord(kind)) + content)

    add("B", bytes(40))
    for name, fields, _, _ in tables:
        add("F", f"{name}:{fields}".encode())
    for number, (name, _, _, _) in enumerate(tables):
        add("A", struct.pack("<BH", 0, number) + name.encode())
    for number, (_, _, layout, rows) in enumerate(tables):
        for t, *values in rows:
            add("D", struct.pack("<H", number) + struct.pack(layout, round(1e6 * t), *values))
    path.write_bytes(bytes(out))
    return path


def isas(flight):
    """Return topics(store): messages as in the bags of ISAS-Walk."""
    kind, inner = "fraunhofer_rtls_flare/msg/RTLSStick", "fraunhofer_rtls_flare/msg/RTLSRange"
    listed, place = (
        "fraunhofer_rtls_flare/msg/Anchorlist",
        "fraunhofer_rtls_flare/msg/AnchorPosition",
    )

    def topics(store):
        ranges = []
        for stamp, heard in ranges_by_time(flight):
            entries = [message(store, inner, id=anchor, range=d, ra=1) for anchor, d in heard]
            entries.append(message(store, inner, id=0, range=99.0, ra=0))  # an outdated entry
            ranges.append(
                (stamp, message(store, kind, header=header(store, stamp), ranges=entries))
            )
        anchors = [
            message(store, place, id=int(number), position=vector(store, "Point", p))
            for number, p in zip(flight.anchors.ids, flight.anchors.positions @ NED.T)
        ]
        imu, pose = "sensor_msgs/msg/Imu", "geometry_msgs/msg/TransformStamped"
        samples = [
            (
                stamp,
                message(
                    store,
                    imu,
                    header=header(store, stamp),
                    angular_velocity=vector(store, "Vector3", g),
                    linear_acceleration=vector(store, "Vector3", a),
                ),
            )
            for stamp, g, a in zip(ns(flight.imu.t), flight.imu.gyro, flight.imu.accel)
        ]
        truth = []
        for stamp, p, q in zip(ns(flight.truth.t), flight.truth.p, flight.truth.q):
            transform = message(
                store,
                "geometry_msgs/msg/Transform",
                translation=vector(store, "Vector3", p),
                rotation=vector(store, "Quaternion", q),
            )
            truth.append(
                (stamp, message(store, pose, header=header(store, stamp), transform=transform))
            )
        return {
            "/rtls_flares": (kind, ranges),
            "/anchor_list": (listed, [(BEGIN, message(store, listed, anchor=anchors))]),
            "/waveshare_sense_hat_b": (imu, samples),
            "/vive/transform/tracker_1_ref": (pose, truth),
        }

    return topics


def write_starloc(folder, flight):
    """Write files like STAR-loc: ranges of two tags and an inertial sensor.

    Ranges of the second tag are 1 m longer.
    """
    folder.mkdir()
    p = np.array(
        [np.interp(flight.range.t, flight.truth.t, column) for column in flight.truth.p.T]
    ).T
    names = "time_s,range,from_id,to_id,tag_pos_x,tag_pos_y,tag_pos_z".split(",")
    rows = [
        [t, d + tag - 1, tag, anchor, *place]
        for t, d, anchor, place in zip(flight.range.t, flight.range.d, flight.range.anchor, p)
        for tag in (1, 2)
    ]
    inertial = [
        f"{name}_{axis}" for name in ("angular_velocity", "linear_acceleration") for axis in "xyz"
    ]
    samples = [[t, *g, *a] for t, g, a in zip(flight.imu.t, flight.imu.gyro, flight.imu.accel)]
    for name, head, table in (("uwb", names, rows), ("imu", ["time_s", *inertial], samples)):
        with gzip.open(folder / f"{name}.csv.gz", "wt", newline="") as file:
            csv.writer(file).writerows([head, *table])
    (folder / "calib.json").write_text("{}")
    return folder
