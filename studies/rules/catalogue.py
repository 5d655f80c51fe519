# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The rules of the compiled core, and its constants that are not tuning parameters."""

from __future__ import annotations

from dataclasses import dataclass

# Whole numbers that are tuned; all others say where something is
COUNTS = {
    "inertial.PERIOD_SAMPLES",
    "ground.MOST_ANCHORS",
    "ground.FEWEST_PAIRS",
    "ground.STILL_TDOAS",
    "ground.STILL_SWEEPS",
    "ground.SWEEPS",
    "height.STEP_COUNT",
    "monitoring.survey_scale.STEPS",
    "initialization.MINIMUM",
    "initialization.SLOW_TDOAS",
    "initialization.SLOW_STAMPS",
    "initialization.AMONG_OTHERS",
    "stationarity.FEWEST_CHECKS",
    "stationarity.LONG",
    "startup.SWEEPS",
    "velocity.STUCK_COUNT",
}
# Numbers that nobody tuned, and what they are
STRUCTURE = {
    "auxiliary.OFFSET_STATES": "size",
    "auxiliary.PRESSURE_DRIFT": "place",
    "auxiliary.RANGE": "place",
    "engine.RECORDS_OF_REST": "size",
    "engine.RECORDS_OF_SENSOR": "size",
    "engine.RECORDS_OF_TDOA": "size",
    "ground.MOST_PAIRS": "size",
    "history.RESET": "kind of a record",
    "hypotheses.LARGEST_NIS": "square of `update.GATE`",
    "inertial.CLIMB_RATE": "place",
    "inertial.SPEED": "place",
    "initialization.ANY_YAW": "deviation of a yaw that may be any",
    "initialization.LATE_ANCHORS": "pairs are tried",
    "initialization.YAW_SEARCH_STD": "a whole turn",
    "memory.HYPOTHESES": "size",
    "memory.N_PLACES": "size",
    "memory.N_YAWS": "size",
    "memory.WINDOW": "size",
    "plane.RECORDS": "size",
    "sensors.RANGE": "place",
    "sensors.VELOCITY": "place",
    "startup.NO_SCALE": "stands for infinity",
    "startup.SMALLEST": "keeps a logarithm finite",
    "startup.STARTS": "the middle and the corners of a box",
    "state.ERROR_STATES": "size",
    "state.GRAVITY": "of nature",
    "state.MOVING_STATES": "size",
    "state.NOMINAL_STATES": "size",
    "stationary_position.EXPLANATIONS": "size",
    "update.JOINT_STATES": "size",
    "update.LONGEST_ROW": "size",
    "update._GATE": "place",
    "update._M_ESTIMATION": "place",
    "velocity.GYRO_BIAS": "place",
    "velocity.LONGEST_STD": "stands for infinity",
    "velocity.YAW_RATE": "place",
    "workspace.ABOVE": "place",
    "workspace.BELOW": "place",
    "yaw_check.ANGLES": "all around in steps of 15 degrees",
    "yaw_check.COSINES": "of `ANGLES`",
    "yaw_check.SINES": "of `ANGLES`",
}


@dataclass(frozen=True)
class Rule:
    """A rule of the core. place : expression in a compiled function of a module, as it stands there;
    instead : what takes its place where the rule is off, "" for a call that is left out; function :
    "" for all of the module.
    """

    name: str
    module: str
    function: str
    place: str
    instead: str = "False"


RULES = (
    # The noise of TDOAs
    Rule("learn the noise of each anchor", "engine", "_update", "parameters.adapt_noise"),
    Rule(
        "one outlier teaches the noise little",
        "noise",
        "learn",
        "min(innovation.value**2, LARGEST_OUTLIER**2 * noise)",
        "innovation.value**2",
    ),
    Rule(
        "more noise near the ground",
        "engine",
        "_update",
        "ground.blur(ekf.hypotheses[ekf.best], parameters.ground_height)",
        "0.0",
    ),
    Rule(
        "curvature adds variance",
        "engine",
        "_compare",
        "update.second_order_variance(hypothesis.x, hypothesis.P, a.position, b.position)",
        "0.0",
    ),
    Rule("a TDOA heard at rest repeats", "stationarity", "repetition", "ekf.resting"),
    Rule(
        "robust weight",
        "update",
        "weigh",
        "weight(parameters.loss, innovation.value / math.sqrt(prior + noise), "
        "parameters.measurement_scale)",
        "1.0",
    ),
    Rule("a negligible weight is none", "update", "weigh", "w < NEGLIGIBLE"),
    Rule(
        "a repeated TDOA is refused",
        "engine",
        "_on_tdoa",
        "initialization.is_repeat(ekf, tdoa)",
    ),
    Rule("a repeated range is refused", "engine", "_on_range", "ranges.is_repeat(ekf, sensor)"),
    # Late anchors near the ground
    Rule(
        "anchors near the ground may be late",
        "engine",
        "_update",
        "not on_floor and ground.find_lateness(a, b, ekf.hypotheses[ekf.best], tdoa.t, "
        "parameters.ground_height)",
    ),
    Rule(
        "a TDOA that is probably late is not used", "engine", "_update", "in_time < ground.NOT_USED"
    ),
    Rule(
        "late only at a grazing angle",
        "ground",
        "may_be_late",
        "tag + anchor < GRAZING * distance",
        "True",
    ),
    Rule(
        "late only where both are low",
        "ground",
        "may_be_late",
        "2.0 * tag * anchor < HALF_WAVE * distance",
        "True",
    ),
    Rule(
        "late anchors are alike at rest",
        "ground",
        "explain",
        "lateness == ALIKE and may_be_late(anchors[rows[i]].position, u, 0.0, "
        "parameters.ground_height)",
    ),
    Rule(
        "the lateness that is known on the floor",
        "engine",
        "_update",
        "ekf.resting and ekf.late_as_known",
    ),
    # Rest
    Rule(
        "a quiet IMU",
        "engine",
        "_on_imu",
        "parameters.zero_velocity and continuous and not ekf.imu_faulty "
        "and inertial.is_quiet(ekf.imu)",
    ),
    Rule("rest by TDOAs", "engine", "_prepare", "t >= ekf.next_look"),
    Rule(
        "zero-velocity updates at samples",
        "engine",
        "_on_imu",
        "stationarity.update_zero_velocity(ekf, sample.t, records)",
        "",
    ),
    Rule(
        "zero-velocity updates without samples",
        "engine",
        "_prepare",
        "stationarity.update_zero_velocity(ekf, t, records)",
        "",
    ),
    Rule(
        "lift-off by the accelerometer",
        "engine",
        "_on_imu",
        "stationarity.detect_liftoff(ekf, sample, sample.t - ekf.imu.t, records)",
        "",
    ),
    Rule(
        "rotors that have stopped are calm",
        "stationarity",
        "check_stationarity",
        "np.sum(ekf.imu.vibration) < CALM * ekf.shaking",
    ),
    Rule(
        "rest is looked for near the ground",
        "stationarity",
        "check_stationarity",
        "stationary_position.is_near_ground(best, parameters)",
    ),
    Rule(
        "too few TDOAs say nothing of rest",
        "stationarity",
        "check_stationarity",
        "motion == ground.UNKNOWN and ekf.quiet",
    ),
    Rule(
        "one look ends a rest after some lift",
        "stationarity",
        "check_stationarity",
        "FEWEST_CHECKS if np.abs(ekf.lift).max() < UNFELT else 1",
        "FEWEST_CHECKS",
    ),
    Rule("landing by late anchors", "stationarity", "check_stationarity", "lateness >= 0"),
    Rule(
        "a low tag may hover",
        "stationarity",
        "check_stationarity",
        "stationary_position.set_hovering_position(ekf, place, still, t, records)",
        "",
    ),
    Rule(
        "a long quiet time is rest",
        "stationarity",
        "check_stationarity",
        "not landed and long and (not _moves(best, QUIET_STD))",
    ),
    Rule(
        "fewer looks soon after a start",
        "stationarity",
        "check_stationarity",
        "t - ekf.rest_since > EARLY",
        "True",
    ),
    Rule(
        "rest ends in a silence",
        "stationarity",
        "update_zero_velocity",
        "ekf.resting and (not ekf.quiet) and (t - ekf.last_tdoa > SILENT)",
    ),
    Rule(
        "a slow quiet tag stands",
        "stationarity",
        "update_zero_velocity",
        "slow and abs(x[state]) < SPEED_STD and (P[state, state] < SPEED_STD**2)",
    ),
    Rule(
        "a quiet tag stands more exactly",
        "stationarity",
        "update_zero_velocity",
        "QUIET_STD if ekf.quiet else SHAKING_STD",
        "SHAKING_STD",
    ),
    Rule(
        "landing by the lateness that is expected",
        "stationary_position",
        "find_landed",
        "_expected_late(pairs, anchors) > FEWEST_LATE",
    ),
    Rule(
        "far above or below the anchors is absurd",
        "stationary_position",
        "",
        "_absurdity(near, x)",
        "0.0",
    ),
    Rule(
        "the spread of the explanations",
        "stationary_position",
        "_mix",
        "k != best and weights[k] > 0.0",
    ),
    Rule(
        "changes that scatter show motion",
        "ground",
        "judge_motion",
        "np.median(ratios[:n]) > EXPECTED_RATIO + LARGEST_RATIO / math.sqrt(n)",
    ),
    Rule("changes that fit a velocity show motion", "ground", "judge_motion", "size >= MOVING"),
    Rule(
        "changes are weighed robustly",
        "ground",
        "judge_motion",
        "1.0 + r * r / (STILL_SCALE**2 * row[4])",
        "1.0",
    ),
    Rule("a tag is rarely outside its workspace", "ground", "_equations", "outside != 0.0"),
    # The inertial sensor
    Rule(
        "an axis rectifies as far as its mean shows",
        "inertial",
        "weigh",
        "max(imu.rectified[k], LEAST_RECTIFIED)",
        "1.0",
    ),
    Rule(
        "a shaking axis weighs less",
        "inertial",
        "weigh",
        "prior / (prior + error)",
        "1.0",
    ),
    Rule(
        "a tag on its side does not hover",
        "inertial",
        "weigh",
        "slow[2] > UPRIGHT * math.sqrt(slow[0] ** 2 + slow[1] ** 2 + slow[2] ** 2)",
        "True",
    ),
    Rule(
        "far from hovering hovers less",
        "inertial",
        "weigh",
        "max(usual, apart**2 - error)",
        "usual",
    ),
    Rule(
        "less noise of a quiet tag",
        "inertial",
        "weigh",
        "QUIET_NOISE**2 if quiet else noise",
        "noise",
    ),
    Rule(
        "IMU fault detector", "imu_fault_detector", "update", "t - detector.contradicted < CLEARED"
    ),
    Rule(
        "IMU fault: weight",
        "imu_fault_detector",
        "update",
        "unsupported and (not LIGHTEST < force_norm < HEAVIEST)",
    ),
    Rule(
        "IMU fault: direction of gravity",
        "imu_fault_detector",
        "update",
        "unsupported or upward_force < DOWNWARDS",
    ),
    Rule(
        "IMU fault: turning rate", "imu_fault_detector", "update", "detector.excess_turn == TOO_FAR"
    ),
    Rule(
        "IMU fault: lying on a side",
        "imu_fault_detector",
        "update",
        "lies and (imu_faulty or t - detector.upright > LYING)",
    ),
    Rule("widen at an IMU fault", "engine", "_switch", "initialization.widen(ekf, records)", ""),
    Rule(
        "level after an IMU fault",
        "engine",
        "_switch",
        "initialization.reset_attitude(ekf, parameters, initialization.YAW_SEARCH_STD, records)",
        "",
    ),
    Rule(
        "level at the first sample",
        "engine",
        "_on_imu",
        "first and ekf.running and parameters.use_imu",
    ),
    # Hypotheses
    Rule(
        "four yaws at the start",
        "initialization",
        "_begin",
        "unknown or offset == 0.0",
        "offset == 0.0",
    ),
    Rule("two places at the start", "initialization", "_begin", "place < len(x)", "place < 1"),
    Rule(
        "hypotheses merge",
        "hypotheses",
        "select",
        "turned < MERGED_BELOW**2 and away < MERGED_WITHIN**2",
    ),
    Rule(
        "one innovation weighs hypotheses little",
        "hypotheses",
        "add_log_likelihood",
        "min(innovation.value**2 / variance, LARGEST_NIS)",
        "innovation.value**2 / variance",
    ),
    Rule(
        "the spread of hypotheses",
        "engine",
        "_report",
        "hypotheses.add_spread_of_means(ekf, row.covariance)",
        "",
    ),
    Rule(
        "a wrong yaw is opened again",
        "engine",
        "_select",
        "alone and yaw_check.contradicts(ekf, t)",
    ),
    Rule("widen at a wrong yaw", "initialization", "open_yaw", "widen(ekf, history)", ""),
    Rule(
        "open the yaw of a tag without IMU",
        "engine",
        "_on_sensor",
        "sensor.kind == sensors.VELOCITY and (not parameters.use_imu)",
    ),
    Rule(
        "a yaw that may be any grows no more",
        "engine",
        "_coast",
        "not parameters.use_imu and hypothesis.P[8, 8] > initialization.ANY_YAW**2",
    ),
    # What is stated
    Rule(
        "covariance of persistent errors",
        "noise",
        "fill",
        "share == 0.0",
        "True",
    ),
    Rule(
        "curvature in the persistent errors",
        "noise",
        "observe",
        "innovation.curvature / SHARE",
        "0.0",
    ),
    Rule(
        "the circle about anchors in a line",
        "engine",
        "_report",
        "workspace.add_circle(ekf, parameters.fixed_height_std > 0.0 or "
        "t - ekf.height.used < height.MEMORY, best.x, row.covariance)",
        "",
    ),
    Rule(
        "TDOAs that contradict a fixed height",
        "engine",
        "_report",
        "height.contradiction(ekf.height, parameters, t)",
        "0.0",
    ),
    Rule("the place that wheels contradict", "engine", "_report", "t < ekf.rival_until"),
    # The workspace
    Rule(
        "the workspace draws back",
        "engine",
        "_select",
        "_stay_in_workspace(ekf, t, records)",
        "",
    ),
    Rule(
        "a wall looks as far as it is long",
        "workspace",
        "set_bounds",
        "k < 2 and high - low < FLAT",
    ),
    Rule("the surroundings follow the tag", "engine", "_prepare", "t >= ekf.next_workspace"),
    # Start and recovery
    Rule(
        "weigh the ground at the start",
        "initialization",
        "start",
        "stationary_position.weigh_explanations(ekf, pairs, anchors, parameters, known, rest_x, "
        "rest_covariance)",
        "-np.inf",
    ),
    Rule(
        "a start is inside the workspace",
        "initialization",
        "start",
        "workspace.contains(ekf.workspace, x[0])",
        "True",
    ),
    Rule(
        "a wide start becomes two",
        "initialization",
        "start",
        "np.trace(rest_covariance[:3, :3]) > APART**2",
    ),
    Rule(
        "a wide slow start becomes two",
        "initialization",
        "start_slowly",
        "np.trace(places.covariance[0, :3, :3]) > APART**2",
    ),
    Rule(
        "a start at rest has no velocity",
        "initialization",
        "start",
        "N_PLACES if still else 0",
        "0",
    ),
    Rule(
        "a start by rest, not by motion",
        "initialization",
        "start",
        "still or on_ground or (not (accepted or cost[1] < np.inf))",
    ),
    Rule(
        "start anyhow after a while",
        "engine",
        "_initialize",
        "waited > parameters.start_timeout",
    ),
    Rule("start from few TDOAs", "engine", "_initialize", "t >= ekf.next_search"),
    Rule("no start over a gap", "initialization", "start_slowly", "gap > LONGEST_GAP * span"),
    Rule(
        "older TDOAs of a start count less",
        "startup",
        "locate",
        "parameters.motion_noise**2 * age**3 / 3.0 / std**2",
        "0.0",
    ),
    Rule(
        "the loss narrows",
        "startup",
        "locate",
        "max(COARSE * 0.7**sweep, FINE)",
        "FINE",
    ),
    Rule(
        "a start is probable in the middle",
        "startup",
        "locate",
        "np.sum(((trial - mean) / prior_std) ** 2)",
        "0.0",
    ),
    Rule(
        "a start is as wide as its residuals",
        "startup",
        "locate",
        "max(std, 1.5 * np.median(np.abs(residuals)))",
        "std",
    ),
    Rule(
        "recover",
        "engine",
        "_recover",
        "parameters.recover and (unsure or ekf.consistency < INCONSISTENT) "
        "and t >= ekf.next_search",
    ),
    Rule(
        "TDOAs wait after a silence",
        "engine",
        "_on_tdoa",
        "parameters.recover and initialization.hold_for_search(ekf, anchors, parameters, t, "
        "ekf.position_unknown_until > before, records)",
    ),
    Rule(
        "relocate where few TDOAs come",
        "engine",
        "_on_tdoa",
        "initialization.relocate(ekf, anchors, parameters, t, records)",
        "",
    ),
    Rule(
        "a lost tag is looked for anywhere",
        "engine",
        "_prepare",
        "t - ekf.last_tdoa > parameters.start_window and initialization.is_unsure(ekf)",
    ),
    Rule(
        "a recovery explains clearly more",
        "initialization",
        "recover",
        "share < CLEARLY_MORE + explained",
    ),
    Rule("a recovery explains most", "initialization", "recover", "share < AGREE_RECOVERY"),
    Rule(
        "a recovery is within reach",
        "initialization",
        "recover",
        "math.sqrt(away) > REACH + REACH_SPEED * since + REACH_ACCELERATION * since**2",
    ),
    Rule(
        "a recovery goes to two places",
        "initialization",
        "recover",
        "anywhere and cost[count - 1] < np.inf",
    ),
    Rule(
        "wheels outweigh another place",
        "initialization",
        "recover",
        "not anywhere and wheels and _outweighs(ekf, anchors, window, x[0], t)",
    ),
    Rule(
        "two late anchors explain another place",
        "initialization",
        "_outweighs",
        "_are_late(window, anchors, ekf.hypotheses[ekf.best].x[:6])",
    ),
    Rule(
        "TDOAs of another place wait",
        "engine",
        "_update",
        "tdoa.t < ekf.rival_until and _is_of_rival(ekf, a, b, tdoa, known)",
    ),
    Rule("stop after a long pause", "engine", "_predict", "t - ekf.t > LOST_TIME"),
    Rule(
        "stop when the tag may be anywhere",
        "engine",
        "_predict",
        "t - ekf.last_tdoa > LOST_TIME and workspace.is_filled(ekf.workspace, "
        "ekf.hypotheses[ekf.best].P)",
    ),
    # Range finder, barometer, velocity
    Rule(
        "a range finder that repeats is stuck",
        "height",
        "observe",
        "not ekf.quiet and sensor.t - height.changed > STUCK_TIME",
    ),
    Rule(
        "a range finder that pulls is ignored",
        "height",
        "observe",
        "sensor.t < height.ignored_until",
    ),
    Rule(
        "a range weighs places",
        "height",
        "observe",
        "_weigh_places(ekf, parameters, distance, share)",
    ),
    Rule(
        "errors of ranges last",
        "height",
        "observe",
        "max(1.0, 2.0 * CORRELATION_TIME / max(min(since, MEMORY), 1e-3))",
        "1.0",
    ),
    Rule(
        "down from a step",
        "height",
        "_settle",
        "height.level != parameters.ground_height and abs(base_innovation) < "
        "min(limit, 2.0 * ALIKE)",
    ),
    Rule(
        "steps of the ground",
        "height",
        "_settle",
        "(height.agreed >= MEMORY or doubted) and abs(value) < HIGHEST_STEP",
    ),
    Rule("a worse barometer counts less", "pressure", "observe", "max(1.0, barometer.nis)", "1.0"),
    Rule(
        "the offset of a barometer is taken anew",
        "pressure",
        "observe",
        "sensor.t - barometer.agreed > MEMORY",
    ),
    Rule("a stuck velocity", "velocity", "observe", "_repeats(state, sensor) and (not ekf.quiet)"),
    Rule(
        "a velocity that disagrees is refused",
        "velocity",
        "observe",
        "state.nis > (AGREES if state.refused else DISAGREES)",
    ),
    Rule("a velocity that is an outlier", "velocity", "observe", "worst > GATE**2"),
    Rule(
        "errors of velocities last",
        "velocity",
        "observe",
        "max(1.0, 2.0 * CORRELATION_TIME / dt)",
        "1.0",
    ),
    Rule(
        "velocities weigh hypotheses",
        "velocity",
        "observe",
        "add_log_likelihood(hypothesis, innovation, inflation)",
        "",
    ),
    Rule("wheels show the gyroscope's bias", "velocity", "observe", "of_wheels and ekf.sensed"),
    Rule("wheels drive", "velocity", "drives", "not state.refused and t - state.agreed < HELD"),
)
# Rules and constants of other modules that only rows with a sensor can show
OF_SENSORS = {
    "a repeated range is refused": "range",
    "open the yaw of a tag without IMU": "velocity",
    "TDOAs that contradict a fixed height": "plane",
    "the place that wheels contradict": "velocity",
    "wheels outweigh another place": "velocity",
    "two late anchors explain another place": "velocity",
    "TDOAs of another place wait": "velocity",
    "initialization.SMALLEST_STD": "height",
    "initialization.RIVAL_TIME": "velocity",
    "initialization.RIVAL_HELD": "velocity",
    "initialization.AMONG_OTHERS": "velocity",
}
