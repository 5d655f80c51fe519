"""What the SENSORS of a recording got wrong, by their own rules."""

from collections.abc import Iterator

from uwb_tdoa_bias.foundation.sensors import SENSORS
from uwb_tdoa_ekf.streams import ERROR, Finding

from .recording import Recording


def sensors(recording: Recording) -> Iterator[Finding]:
    """Findings about the Streams of a Recording."""
    for name, stream in recording.sensors.items():
        for rule in SENSORS[name].rules:
            if (found := rule(stream, recording.anchors)) is not None:
                yield Finding(found.rule, ERROR, found.cause, found.evidence, found.remedy, found.value)
