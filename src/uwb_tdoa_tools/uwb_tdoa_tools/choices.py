# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Names and defaults that options show, for parsers that import nothing else.

The modules that implement the names take them from here where they can. `test_commands.py` compares the
others: registries of functions and classes.
"""

STORAGES = "mcap", "sqlite3"  # kinds of bags
ALIGN = NONE, TIME, FRAME = "none", "time", "frame"  # how far a ground truth is aligned
REFERENCES = "truth", "heights", "marks", "odometry", "nothing"  # of diagnose
MODELS = "paper", "physics"  # of train
# m per square root of a second, of the path of another odometry: 1 % after 200 m at 1 m/s, as
# visual-inertial odometry
DRIFT = 0.02
PLAN_TIME, PLAN_SPEED = 60.0, 1.0  # s and m/s, of a flight that diagnose plans
TAPE_STD, TRUSTED_STD = 0.1, 0.01  # m, of a coordinate of an anchor by a tape, and of a trusted one
WAIT = 10.0  # s, until a subscription to a replay must exist
MAP_ACCURACY = 1.0  # m, largest 3D standard deviation of an anchor of a first map

# Texts of options that several commands have
RECORDINGS = "recordings: raw logs, UTIL CSV files, bags, or folders that hold them"
SURVEY = (
    "anchor survey (total station .txt, const .csv or anchors .yaml), or a folder of them: "
    "then anchor_KEY.* serves "
    "the recordings whose path contains KEY; counts in place of the anchors that bags hold, "
    "which keep their own where no KEY fits"
)
PROFILE = (
    "how to read recordings of others: a profile that is shipped "
    "(convert --suggest names it), or your own YAML file (docs/recordings.md)"
)
COLUMNS = (
    "for CSV files of other tools: their columns, OURS=THEIRS[:UNIT],... (anchor_a, anchor_b, "
    "tdoa; or anchor, range; "
    "gyro_x ...; accel_x ...; pose_x ...; time, or tdoa_time, range_time, imu_time, "
    "gyro_time, accel_time, pose_time where a sensor has its own)"
)

# Simulation and flying
TRAJECTORIES = (
    "circle",
    "rising_circle",
    "sines",
    "square",
    "line_x",
    "line_y",
    "hover",
    "spin",
)
CONSTELLATIONS = (
    "corners",
    "tilted",
    "low_ceiling",
    "small_room",
    "wall_middles",
    "staircase",
    "pillars",
    "six",
    "six_wide",
    "hall",
    "planar",
    "pair",
)
YAW_PROFILES = "fixed", "along_track", "rotating"
PROTOCOLS = "tdoa2", "tdoa3"
CARRIERS = "quadrotor", "rover", "hand"  # what carries a simulated tag
FLOWN = "quadrotor", "rover"  # what flies, or drives, by the estimate
WORLDS = (
    "hall",
    "no-floor-effect",
    "low-first",
    "outliers",
    "three-kinds",
    "person",
    "anchor-silent",
    "anchor-late",
    "silence-1s",
    "silence-3s",
    "latency",
    "jitter",
    "tdoa3",
    "gusts",
    "measured-vibration",
    "rectifying",
    "table",
)
MOMENTS = "rest", "lift-off", "circle", "landing", "anywhere"

# Planning
OF_PROTOCOL = {
    "tdoa2": "ring",
    "tdoa3": "all_pairs",
    "ranges": "every_range",
    "tdoa2+ranges": "ring+every_range",
    "tdoa3+ranges": "all_pairs+every_range",
}
ACCURACY = 0.5  # m, of the bound of one round
CRITERIA = {
    "round": "a whole round of all that is heard has one solution",
    "pairings": (
        "every choice of k + 1 anchors alone has one solution, inside their hull (Grasso et al., "
        "sec. 2.3.2)"
    ),
}
