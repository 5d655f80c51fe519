"""All declared effects, by name."""

from .accel_bias import AccelBias
from .accel_scale import AccelScale
from .anchor_clock_drift import AnchorClockDrift
from .anchor_delay import AnchorDelay
from .anchor_ids import AnchorIds
from .anchor_position import AnchorPosition
from .antenna_pattern import AntennaPattern
from .barometer_drift import BarometerDrift
from .floor_multipath import FloorMultipath
from .floor_step import FloorStep
from .gyro_bias import GyroBias
from .gyro_scale import GyroScale
from .height_offset import HeightOffset
from .height_scale import HeightScale
from .imu_gravity import ImuGravity
from .imu_misalignment import ImuMisalignment
from .nlos import Nlos
from .noise_correlation import NoiseCorrelation
from .noise_level import NoiseLevel
from .outlier_rate import OutlierRate
from .pair_offset import PairOffset
from .pair_sign import PairSign
from .range_bias import RangeBias
from .range_delay import RangeDelay
from .range_offset import RangeOffset
from .range_scale import RangeScale
from .received_power_bias import ReceivedPowerBias
from .tag_lever_arm import TagLeverArm
from .tdoa_time_offset import TdoaTimeOffset
from .truth_frame import TruthFrame
from .truth_time_offset import TruthTimeOffset
from .velocity_delay import VelocityDelay
from .velocity_misalignment import VelocityMisalignment
from .velocity_scale import VelocityScale, YawRateScale
from .velocity_slip import VelocitySlip

EFFECTS = {
    effect.name: effect
    for effect in (
        AnchorDelay,
        PairOffset,
        AnchorPosition,
        TagLeverArm,
        TdoaTimeOffset,
        TruthTimeOffset,
        TruthFrame,
        RangeScale,
        RangeBias,
        ReceivedPowerBias,
        AntennaPattern,
        AnchorClockDrift,
        Nlos,
        FloorMultipath,
        GyroBias,
        GyroScale,
        AccelBias,
        AccelScale,
        ImuMisalignment,
        ImuGravity,
        NoiseLevel,
        NoiseCorrelation,
        OutlierRate,
        HeightOffset,
        HeightScale,
        FloorStep,
        BarometerDrift,
        VelocityScale,
        YawRateScale,
        VelocityMisalignment,
        VelocityDelay,
        VelocitySlip,
        RangeOffset,
        RangeDelay,
        AnchorIds,
        PairSign,
    )
}
