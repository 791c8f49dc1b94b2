"""What the messages of a channel are, by the schema in the file."""

from mcap.records import Channel, Schema

from aemd.record.chunk import MessageKind
from aemd.record.schema import COLUMNS, ENCODING, SCHEMAS, WITNESS, WITNESS_PREFIX, make_layout

__all__ = ["is_ours", "kind_of"]


def is_ours(topic: str) -> bool:
    """Tell whether a topic is one of those that we write."""
    return topic in SCHEMAS or topic.startswith(WITNESS_PREFIX)


def kind_of(channel: Channel, schema: Schema | None) -> MessageKind:
    """Return what the messages of one of our channels are.

    Raises:
        ValueError: they are not of our schema; the message says so without the file.
    """
    topic = channel.topic
    needed = SCHEMAS.get(topic, WITNESS)
    if schema is None or schema.name != needed or channel.message_encoding != ENCODING:
        name = "no schema" if schema is None else f"{schema.name!r} as {channel.message_encoding!r}"
        raise ValueError(f"topic {topic} has {name}; we read {needed} as {ENCODING} only")
    if needed not in COLUMNS:
        return MessageKind(topic, needed, None)
    layout = make_layout(schema.data, needed, COLUMNS[needed])
    if layout is None:
        raise ValueError(
            f"topic {topic} has a {needed} that lacks one of {', '.join(COLUMNS[needed])}, or has "
            "fields without fixed width and presence; we read those of aemd only"
        )
    return MessageKind(topic, needed, layout)
