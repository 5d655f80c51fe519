# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Makes the corpus that fuzzing starts from, of simulated and made-up recordings:  python
make_corpus.py
"""

from dataclasses import replace
import gzip
from pathlib import Path
import shutil
import sys
import tempfile

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
sys.path += [
    str(ROOT / "src" / package / "test") for package in ("uwb_tdoa_tools", "uwb_tdoa_bias")
]

from foreign_recordings import two_way_ranges, write_ros_1  # noqa: E402
import known_answer  # noqa: E402
import numpy as np  # noqa: E402
from recordings import ROWS, SURVEY, csv_text, log_bytes, small_flight  # noqa: E402
from rosbags.rosbag1 import Writer  # noqa: E402
from test_survey import survey_lines  # noqa: E402

from studies.fuzzing.targets import CORPUS, MESSAGES, bag_of  # noqa: E402
from uwb_tdoa_bias.common.flyable import FlyableVolume  # noqa: E402
from uwb_tdoa_bias.common.sensors import Height, Pressure, Velocity  # noqa: E402
from uwb_tdoa_bias.common.sensors.ranges import Ranges  # noqa: E402
from uwb_tdoa_bias.effects import EFFECTS, EffectSet  # noqa: E402
from uwb_tdoa_ekf.debias import BiasMap  # noqa: E402
from uwb_tdoa_tools.bags.bag import write_bag  # noqa: E402
from uwb_tdoa_tools.bags.files import open_bag  # noqa: E402
from uwb_tdoa_tools.bags.integrity import CHECKSUM_KEY, NO_CHECKSUM, metadata  # noqa: E402
from uwb_tdoa_tools.simulation.rooms import corners  # noqa: E402

TEXTS = {
    "yaml": [
        "a: [1, -2.5e3, .5, true, ~, 'x']\nb: {c: \"\\u00e4\"}\n3: |\n  text\n",
        "- - 1\n  - {a: b}\n# end\n",
    ],
    "config": [
        (
            "ekf_node:\n  ros__parameters: {tdoa_std: 0.2, robust: gate, adapt_noise: false, "
            "iterations: 3}\n"
        )
    ],
    "places": ["places: [[0, 0, 0, 4, 0, 3], [0, 0, 0, 0.5, 5, 0]]\n"],
    "antenna": [
        (
            "azimuth: [0, -1, 0, -1]\nelevation_1: [0, -9, 0, -9]\nelevation_2: [-1, -9, -1, "
            "-9]\ngain_offset: 2\n"
        )
    ],
    "walls": ["walls: [[0, -5, 0, 5], [2, 0, 2.5, 4, 1.8]]\n"],
    "profile": [
        (
            "about: text\nantenna: {7: [0.1, 0.2, 0.3]}\nsources:\n"
            "  - {type: '*/TwoWayRangeStamped', where: {range_raw: '> 0', UWB_ID2: [0, 1, 5]}, "
            "columns: {anchor: UWB_ID2, range: '-range_raw:cm', time: header.stamp}}\n"
            "  - {topic: '/{name}/pose*', body: frd, world: ned, each: poses, columns: {pose_x: 'p[0]:mm', "
            "pose_y: p.y, pose_z: index}}\n"
            "types: {a/msg/B: uint8 c}\n"
        )
    ],
    "marks": [
        "marks:\n- {flight: monday, from: 12.0, to: 14.0, position: [1.0, -2.0, 0.5], std: 0.05}\n"
    ],
    "distances": ["a,b,distance,std\n0,1,5.25,0.01\n1,5,6.5,0.02\n"],
    "tags": [
        (
            "anchors_file: anchors.yaml\ntdoa_std: 0.2\ntags:\n  tag1: {body_frame: one}\n  tag2: "
            "{robust: gate}\n"
        )
    ],
    "peers": ["flight,peer,mode,rmse_3d,diverged\na,ours,raw,0.25,False\nb,theirs,raw,0.5,True\n"],
    "columns": [
        "t,from,to,d,gx,gy,gz,ax,ay,az\n10,0,1,250,,,,,,\n11,,,,0.1,0,0,0,0,9.81\n12,1,5,-500,0,0,0,0,0.5,9.81\n"
    ],
    "survey": [
        SURVEY,
        "\n".join(survey_lines()[0]) + "\nlandmark,1,2,3\n",
        "anchors: {0: {position: [1, 2, 3]}}\n",
        "name,x,y,z\ndoor,0,0,2\n0x1A2B,4,0,2\n",
    ],
    "table": ["true_x,x\n0.5,0.6\n1,1.1\n", 'x,note,true_x\r\n1,"a, b",2\r\n'],
    "csv": [
        csv_text(),
        csv_text("t_tdoa,idA,idB,tdoa_meas", ["0.1,0,1,0.5", "0.2,1,5,-1e-1"]),
        csv_text(  # one inertial sample, with optical flow: found by fuzzing
            "t_tdoa,idA,idB,tdoa_meas,t_acc,acc_x,acc_y,acc_z,t_gyro,gyro_x,gyro_y,gyro_z,t_tof,tof,t_flow,deltaX,deltaY",
            [
                "0.1,0,1,0.5,0.1,0,0,1,0.1,0,0,1,0.1,300,0.1,1,2",
                "0.2,1,5,-1e-1,,,,,,,,,0.2,301,0.2,2,1",
            ],
        ),
    ],
}
SENSOR_NAMES = {  # streams of a Flight
    "height": Height(np.array([10.0, 10.1]), np.array([1.25, np.inf])),
    "pressure": Pressure(np.array([10.0]), np.array([101325.0])),
    "velocity": Velocity(
        np.array([10.0]), np.array([[0.5, -0.5, 0.0]]), np.array([[0.1, 0.1, np.inf]])
    ),
}


def write(name, number, content):
    folder = CORPUS / name
    folder.mkdir(parents=True, exist_ok=True)
    (folder / str(number)).write_bytes(content.encode() if isinstance(content, str) else content)


def main():
    shutil.rmtree(CORPUS, ignore_errors=True)
    for name, texts in TEXTS.items():
        for number, text in enumerate(texts):
            write(name, number, text)
    write("csv", "packed", gzip.compress(csv_text().encode(), mtime=0))
    write("log", 2, log_bytes())
    write(
        "log",
        1,
        log_bytes([(name, ticks // 1000, values) for name, ticks, values in ROWS], version=1),
    )
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        corners().to_yaml(folder / "anchors.yaml")
        write("survey", "written", (folder / "anchors.yaml").read_bytes())
        known = [
            EFFECTS["anchor_delay"]({"3": 0.1, "5": -0.05}),
            EFFECTS["tag_lever_arm"]({"z": 0.1}),
        ]
        EffectSet(tuple(known)).to_yaml(folder / "effects.yaml")
        write("effects", 0, (folder / "effects.yaml").read_bytes())
        _bags(folder)
        _maps(folder)
    write("model", 0, known_answer.make().SerializeToString())
    size = sum(path.stat().st_size for path in CORPUS.rglob("*") if path.is_file())
    print(f"{size / 1e3:.0f} kB in {CORPUS}")


def _bags(folder):
    """Few messages of few topics: what they hold is fuzzed as bag_message, and a bag of all takes
    50 ms to read.
    """
    flight = replace(small_flight(0.004), imu=None, truth=None)
    write_bag(flight, folder / "small")
    write("bag_mcap", "small", (folder / "small" / "small.mcap").read_bytes())
    # without chunks and QoS, which take long
    write("bag_mcap", "plain", bag_of("/odometry", MESSAGES["/odometry"], b""))
    text = (folder / "small" / "metadata.yaml").read_text()
    write(
        "bag_metadata",
        0,
        text.replace(metadata(folder / "small")["custom_data"][CHECKSUM_KEY], NO_CHECKSUM),
    )
    write("bag_packed", "small", (folder / "small" / "small.mcap").read_bytes())
    write_bag(flight, folder / "tables", "sqlite3")
    write_bag(replace(small_flight(0.008), **SENSOR_NAMES), folder / "aided")
    with open_bag(folder / "aided") as reader:
        for topic, _, data in {c.topic: (c.topic, t, d) for c, t, d in reader.messages()}.values():
            if topic in MESSAGES:
                write(
                    "bag_message",
                    topic.strip("/").replace("/", "_"),
                    bytes([list(MESSAGES).index(topic)]) + data,
                )
    ranges = replace(
        flight, range=Ranges(flight.tdoa.t[:8], flight.tdoa.a[:8], 1.0 + flight.tdoa.t[:8])
    )
    for name, compression in (("plain", None), ("bz2", Writer.CompressionFormat.BZ2)):
        bag = write_ros_1(folder / name, two_way_ranges(ranges), compression)
        write("bag_ros_1", name, bag.read_bytes())
    write("bag_sqlite", "small", (folder / "tables" / "tables.db3").read_bytes())


def _maps(folder):
    anchors = corners()
    cells = np.zeros((3, 2, 2), bool)
    FlyableVolume(
        [0, 0, 0], [1, 1, 1], cells, np.ones(cells.shape), anchors.ids, anchors.positions
    ).save(folder / "v.npz")
    _write_map("flyable", folder / "v.npz")
    cell = np.stack(np.meshgrid(*[np.arange(2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    bias, own = 0.1 + 0.0 * cell, {"ids": anchors.ids, "positions": anchors.positions}
    BiasMap(cell, 0.5 * cell, bias, bias, np.full(8, 9), np.eye(3), 0.5, **own).save(
        folder / "m.npz"
    )
    _write_map("bias_map", folder / "m.npz")


def _write_map(name, file):
    """As it is written, and not compressed: then single numbers can be changed."""
    write(name, 0, file.read_bytes())
    with np.load(file) as content:
        np.savez(file, **content)
    write(f"{name}_sealed", 0, file.read_bytes())


if __name__ == "__main__":
    main()
