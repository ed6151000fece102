"""ROS 1 and ROS 2 bags as streams of messages, through the package `rosbags`; no ROS is needed."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapfusion.errors import InputError, did_you_mean, one_line
from mapfusion.recordings.text_tables import NS

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

_MOST_TOPICS = 12  # of a bag, named in a message


class Bag:
    """An open bag. Whatever is wrong with its bytes is an InputError that names it."""

    def __init__(self, path: Path) -> None:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        if not path.exists():
            raise InputError(f"{path}: no such file or folder (a ROS bag)")
        self.path = path
        try:
            # bags of ROS 2 that carry no definitions have those that have been there since Humble
            self._reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self._reader.open()
        except Exception as error:  # the readers of several formats leave by any door
            raise self._damaged(error) from error

    def _damaged(self, error: Exception) -> InputError:
        reason = one_line(str(error)) or type(error).__name__
        return InputError(f"{self.path}: damaged or no ROS bag ({reason})")

    @property
    def topics(self) -> dict[str, str]:
        """Type of each topic's messages."""
        return {each.topic: each.msgtype for each in self._reader.connections}

    def require(self, option: str, topic: str, *types: str) -> str:
        """The type of a topic.

        Raises:
            InputError: there is no such topic, or its type is none of these; names the option.
        """
        known = self.topics
        if topic not in known:
            named = ", ".join(sorted(known)[:_MOST_TOPICS]) or "none"
            meant = did_you_mean(topic, known)
            raise InputError(f"{self.path}: {option} {topic}: no such topic{meant}; there: {named}")
        if known[topic].rsplit("/", 1)[-1] not in types:
            wanted = " or ".join(types)
            found = f"holds {known[topic]}, expected {wanted}"
            raise InputError(f"{self.path}: {option} {topic}: {found}")
        return known[topic]

    def messages(self, topic: str, at_ns: int | None = None) -> Iterator[tuple[int, Any]]:
        """When each message of a topic was recorded (ns), and the message; only those of a time."""
        own: list[Connection] = [each for each in self._reader.connections if each.topic == topic]
        stop = None if at_ns is None else at_ns + 1
        try:
            for connection, time_ns, data in self._reader.messages(own, at_ns, stop):
                yield time_ns, self._reader.deserialize(data, connection.msgtype)
        except InputError:
            raise
        except Exception as error:
            raise self._damaged(error) from error

    def first(self, topic: str) -> Any:
        """The first message of a topic; raises InputError where there is none."""
        for _, message in self.messages(topic):
            return message
        raise InputError(f"{self.path}: topic {topic} holds no message")


def stamp_ns(message: Any) -> int:
    """When a message says that it was measured."""
    stamp = message.header.stamp
    return int(stamp.sec) * NS + int(stamp.nanosec)
