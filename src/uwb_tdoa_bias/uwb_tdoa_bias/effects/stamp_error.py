"""What the effects on stamps share: a stream is stamped some seconds after the instant it was taken at."""

from dataclasses import replace

from .base import Effect


class StampEffect(Effect):
    """An effect on the stamps of one stream. Subclasses say which, by its name in a Flight."""

    stream = "tdoa"

    @classmethod
    def groups(cls, anchors, pairs):
        return [("offset",)]

    def stamp_offset(self, stream):
        return self.values.get("offset", 0.0) if stream == self.stream else 0.0

    def inject(self, flight, rng=None):
        return shifted(flight, self.stream, self.stamp_offset(self.stream))


def shifted(flight, stream, seconds):
    """The Flight with `seconds` added to the stamps of a stream, which may be missing."""
    part = getattr(flight, stream)
    return flight if part is None or not seconds else replace(flight, **{stream: replace(part, t=part.t + seconds)})
