"""The unit of 16-bit depth, where a recording says it: RealSense's own bags do, by an option."""

from __future__ import annotations

from recordings.cameras.matching import namespace, shared_namespace
from recordings.messages.decoded_bag import DecodedBag
from recordings.messages.types import NumberMessage

_OPTION = ("option", "depth_units")
_DIGITS = 6
"""Single precision has no more: 0.001 comes as 0.0010000000475."""


def is_depth_unit(topic: str) -> bool:
    """Whether a topic holds the unit of a sensor's depth: /device_0/sensor_0/option/Depth Units/value."""
    return tuple(part.lower().replace(" ", "_") for part in namespace(topic)[-2:]) == _OPTION


def recorded_unit_m(decoded: DecodedBag, depth_topic: str) -> float | None:
    """Metres for a stored 1 of a depth topic, by the option of its own sensor; None where there is none."""
    for topic in decoded.topic_names:
        sensor = namespace(topic)[: -len(_OPTION)]
        if is_depth_unit(topic) and shared_namespace(topic, depth_topic) == len(sensor):
            message = decoded.first(topic)
            if isinstance(message, NumberMessage) and 0 < message.value <= 1:
                return float(f"{message.value:.{_DIGITS}g}")
    return None
