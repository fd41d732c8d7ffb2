"""Which decoder reads a topic: chosen by encoding and schema, never by the topic's name."""

from __future__ import annotations

from collections.abc import Callable

from mcap.well_known import MessageEncoding

from recordings.mcap_files.mcap_file import Topic
from recordings.messages import foxglove, ros2
from recordings.messages.types import DecodedMessage, UndecodableMessage

Decoder = Callable[[bytes], DecodedMessage]


def decoder_of(topic: Topic) -> Decoder | None:
    """The decoder of a topic's messages, or None where they say nothing that a recording needs.

    The decoder raises UndecodableMessage, whatever is wrong with a message.
    """
    try:
        if topic.message_encoding == MessageEncoding.CDR:
            decode = ros2.decoder(topic.schema_name, topic.schema_encoding, topic.schema_data)
        elif topic.message_encoding == MessageEncoding.ROS1:
            decode = ros2.ros1_decoder(topic.schema_name)
        elif topic.message_encoding == MessageEncoding.Protobuf:
            decode = foxglove.protobuf_decoder(topic.schema_name, topic.schema_encoding, topic.schema_data)
        elif topic.message_encoding == MessageEncoding.JSON:
            decode = foxglove.json_decoder(topic.schema_name)
        else:
            decode = None
    except Exception:
        return None
    return None if decode is None else _guarded(decode)


def _guarded(decode: Decoder) -> Decoder:
    def decode_or_explain(data: bytes) -> DecodedMessage:
        try:
            return decode(data)
        except UndecodableMessage:
            raise
        except Exception as error:  # the decoders of three libraries raise all kinds on damaged bytes
            raise UndecodableMessage(f"does not fit its schema ({_reason(error)})") from error

    return decode_or_explain


def _reason(error: Exception) -> str:
    """What a decoder of another library says, in one short line."""
    if isinstance(error, AttributeError) and error.name:
        return f"no {error.name}"
    return f"{type(error).__name__}: {error}".partition("\n")[0][:80]
