"""Radio link between robots: period, range, loss, delay and data rate."""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from mapfusion.parameters import Range, require_in_range
from mapfusion.team.map_message import MapMessage


@dataclass(frozen=True)
class LinkParameters:
    """Settings of the link.

    Attributes:
        every: number of frames between two exchanges of maps. A robot that goes on in the joint map
            forgets landmarks that it has seen too rarely for its map; with fewer frames it would
            forget many.
        range_m: largest distance of two robots that hear each other; None: any.
        loss: probability that a message is lost.
        delay_s: time between the end of a transmission and its arrival.
        bytes_per_s: data rate of a robot's transmitter; None: a message takes no time.
    """

    every: Annotated[int, Range(5, 1_000_000, "frames")] = 20
    range_m: Annotated[float, Range(0, 1e6, "m")] | None = None
    loss: Annotated[float, Range(0, 1, "1")] = 0.0
    delay_s: Annotated[float, Range(0, 1e6, "s")] = 0.0
    bytes_per_s: Annotated[float, Range(1, 1e12, "bytes/s")] | None = None

    def __post_init__(self) -> None:
        require_in_range(self)


class Transmission(NamedTuple):
    """Message on its way.

    Attributes:
        sender: index of the sender.
        receiver: index of the receiver.
        arrives_s: time of its arrival; infinite if it is lost.
        message: the message.
    """

    sender: int
    receiver: int
    arrives_s: float
    message: MapMessage

    @property
    def is_lost(self) -> bool:
        """True if the message never arrives."""
        return self.arrives_s == np.inf


class Link:
    """Link of N robots.

    A transmitter sends one message after the other.

    Args:
        n_robots: N.
        parameters: settings.
        rng: random generator of the losses.
    """

    def __init__(self, n_robots: int, parameters: LinkParameters, rng: np.random.Generator) -> None:
        self.parameters, self._rng = parameters, rng
        self._free_s = np.full(n_robots, -np.inf)
        self._on_way: list[Transmission] = []

    def is_free(self, sender: int, now_s: float) -> bool:
        """Return True if a transmitter has sent all its messages."""
        return bool(self._free_s[sender] <= now_s)

    def send(
        self, sender: int, receiver: int, message: MapMessage, now_s: float, distance_m: float
    ) -> Transmission:
        """Send a message; it waits for the messages before it.

        Args:
            sender: index of the sender.
            receiver: index of the receiver.
            message: the message.
            now_s: the present time.
            distance_m: distance of the two robots.
        """
        settings = self.parameters
        starts_s = max(now_s, self._free_s[sender])
        takes_s = 0.0 if settings.bytes_per_s is None else message.n_bytes / settings.bytes_per_s
        self._free_s[sender] = starts_s + takes_s
        is_lost = self._rng.random() < settings.loss
        is_lost |= settings.range_m is not None and distance_m > settings.range_m
        arrives_s = np.inf if is_lost else starts_s + takes_s + settings.delay_s
        sent = Transmission(sender, receiver, arrives_s, message)
        if not is_lost:
            self._on_way.append(sent)
        return sent

    def arrived(self, now_s: float) -> list[Transmission]:
        """Return the messages that have arrived since the last call, by time of arrival."""
        here = [sent for sent in self._on_way if sent.arrives_s <= now_s]
        self._on_way = [sent for sent in self._on_way if sent.arrives_s > now_s]
        return sorted(here, key=lambda sent: (sent.arrives_s, sent.sender, sent.receiver))
