"""The messages of a recording, decoded."""

from __future__ import annotations

from collections.abc import Collection, Iterator

from recordings.mcap_files.bag import Bag
from recordings.mcap_files.mcap_file import Topic
from recordings.messages.decoding import Decoder, decoder_of
from recordings.messages.types import DecodedMessage, UndecodableMessage


class DecodedBag:
    """A recording's topics that hold images, cameras, points or poses."""

    def __init__(self, bag: Bag) -> None:
        self.bag = bag
        self._decoders: dict[Topic, Decoder] = {
            topic: decoder for topic in bag.topics if (decoder := decoder_of(topic)) is not None
        }

    @property
    def topic_names(self) -> list[str]:
        """The topics that can be decoded, in the order of the alphabet."""
        return sorted({topic.name for topic in self._decoders})

    @property
    def unread_topics(self) -> list[Topic]:
        """The other topics: of unknown types or encodings."""
        return [topic for topic in self.bag.topics if topic not in self._decoders]

    def messages(self, topics: Collection[str]) -> Iterator[tuple[int, DecodedMessage | UndecodableMessage]]:
        """Log time and content of every message of the named topics; the error where it has none."""
        for topic, log_time_ns, data in self.bag.messages(topics):
            if topic in self._decoders:
                try:
                    yield log_time_ns, self._decoders[topic](data)
                except UndecodableMessage as error:
                    yield log_time_ns, error

    def undecodable_topics(self) -> dict[str, int]:
        """A sentence on each topic of which no message can be decoded, and how many it has."""
        found = {}
        for topic in self.topic_names:
            errors = []
            for _, message in self.messages({topic}):
                if not isinstance(message, UndecodableMessage):
                    errors = []
                    break
                errors.append(message)
            if errors:
                found[f"{topic}: none of its messages can be decoded; the first {errors[0]}"] = len(errors)
        return found

    def first(self, topic: str) -> DecodedMessage | None:
        """The first message of a topic that can be decoded."""
        for _, message in self.messages({topic}):
            if not isinstance(message, UndecodableMessage):
                return message
        return None
