"""The registry of the sensors that a tag may have beside inertia and UWB: one sensor, one file, one
line here.
"""

from . import height, pressure, ranges, velocity
from .height import Height
from .pressure import Pressure
from .ranges import Ranges
from .sensor import Sensor, Stream
from .velocity import Velocity

SENSORS = {
    each.SENSOR.name: each.SENSOR for each in (height, pressure, velocity, ranges)
}  # by name, in the order of their kinds in the filter

LOCATING = tuple(
    name for name, sensor in SENSORS.items() if sensor.locates
)  # from which alone the filter can start
DIAGNOSED = tuple(
    name for name, sensor in SENSORS.items() if sensor.compared is not None
)  # channels of the diagnosis, of which
BY_POSE = tuple(
    name for name in DIAGNOSED if SENSORS[name].compared.reading
)  # these are compared with poses, others with anchors too

__all__ = [
    "BY_POSE",
    "DIAGNOSED",
    "LOCATING",
    "SENSORS",
    "Height",
    "Pressure",
    "Ranges",
    "Sensor",
    "Stream",
    "Velocity",
]
