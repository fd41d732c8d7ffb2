"""How messages of our own topics are described in the file, so that any MCAP tool reads them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap_protobuf.schema import build_file_descriptor_set

from recordings.writer import MessageSchema


def json_schema(name: str, schema: Mapping[str, Any]) -> MessageSchema:
    """Schema of a topic of JSON objects, as JSON Schema has it."""
    return MessageSchema(
        name=name,
        encoding=SchemaEncoding.JSONSchema,
        data=json.dumps({"title": name, **schema}).encode(),
        message_encoding=MessageEncoding.JSON,
    )


@lru_cache
def protobuf_schema(message_class: Any) -> MessageSchema:
    """Schema of a topic of protobuf messages, with every type that it uses."""
    return MessageSchema(
        name=message_class.DESCRIPTOR.full_name,
        encoding=SchemaEncoding.Protobuf,
        data=build_file_descriptor_set(message_class).SerializeToString(),
        message_encoding=MessageEncoding.Protobuf,
    )
