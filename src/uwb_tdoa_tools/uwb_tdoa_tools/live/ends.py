"""Who publishes and hears a topic."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class End:
    """A publisher or a subscription. topic, node : absolute names; kind : type of its messages;
    reliable, latched : its QoS, best effort and volatile otherwise.
    """

    topic: str
    node: str
    kind: str
    publishes: bool
    reliable: bool
    latched: bool

    @property
    def qos(self) -> str:
        """In words."""
        return (
            f"{'reliable' if self.reliable else 'best effort'}, "
            f"{'transient local' if self.latched else 'volatile'}"
        )

    def gets(self, publisher: End) -> bool:
        """Whether a subscription gets what a publisher of its topic sends (DDS: it may not ask for
        more than is offered).
        """
        return publisher.reliable >= self.reliable and publisher.latched >= self.latched
