"""All declared effects, by name. The file of each is named after it."""

from .accel_bias import AccelBias
from .accel_scale import AccelScale
from .anchor_clock_drift import AnchorClockDrift
from .anchor_delay import AnchorDelay
from .anchor_position import AnchorPosition
from .antenna_pattern import AntennaPattern
from .floor_multipath import FloorMultipath
from .gyro_bias import GyroBias
from .gyro_scale import GyroScale
from .imu_gravity import ImuGravity
from .imu_misalignment import ImuMisalignment
from .nlos import Nlos
from .noise_correlation import NoiseCorrelation
from .noise_level import NoiseLevel
from .outlier_rate import OutlierRate
from .pair_offset import PairOffset
from .range_bias import RangeBias
from .range_scale import RangeScale
from .received_power_bias import ReceivedPowerBias
from .tag_lever_arm import TagLeverArm
from .tdoa_time_offset import TdoaTimeOffset
from .truth_frame import TruthFrame
from .truth_time_offset import TruthTimeOffset

EFFECTS = {
    effect.name: effect
    for effect in (
        AnchorDelay, PairOffset, AnchorPosition, TagLeverArm, TdoaTimeOffset, TruthTimeOffset, TruthFrame, RangeScale,
        RangeBias, ReceivedPowerBias, AntennaPattern, AnchorClockDrift, Nlos, FloorMultipath, GyroBias, GyroScale,
        AccelBias, AccelScale, ImuMisalignment, ImuGravity, NoiseLevel, NoiseCorrelation, OutlierRate,
    )
}  # fmt: skip
