"""Parse the definitions of message types that a recording contains.

A decoder is generated from each type. The size of a type is limited, so that a damaged or hostile file cannot cause a
huge decoder.
"""

from __future__ import annotations

from typing import Any, Final

from plow_twin.errors import RecordingError

#: Largest length [characters] of a type's text, including the types of its fields but not the comments. Common texts
#: have about 10,000 characters.
_LONGEST: Final = 2**18
#: Largest number of parts of a message. A part is a number, a text or an array of numbers. A sequence of any length
#: counts as one item.
_MOST_PARTS: Final = 1_000


def parsed_types(text: str, message_type: str) -> dict[str, Any]:
    """Return the types that a `ros2msg` text defines.

    Raise `RecordingError` if the text is too long, the type contains itself, or the type has too many parts. For any
    other fault of the text, the parser of rosbags raises its own errors.
    """
    from rosbags.typesys import get_types_from_msg

    # empty lines are removed, because the parser's time grows with the square of the number of consecutive empty lines
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if sum(map(len, lines)) > _LONGEST:
        raise RecordingError(f"{message_type}: got a longer text, expected at most {_LONGEST} characters")
    types: dict[str, Any] = get_types_from_msg("\n".join(lines) + "\n", message_type)
    counts: dict[str, int] = {}
    for name in types:
        _count(name, types, counts)
    return types


def _count(name: str, types: dict[str, Any], counts: dict[str, int]) -> int:
    """Return the number of parts of a message type; a type that `types` does not contain counts as one part."""
    if name not in types:
        return 1
    if name not in counts:
        # a type that contains itself is refused, because this value is read while its parts are counted
        counts[name] = _MOST_PARTS + 1
        counts[name] = max(1, sum(_parts(field, types, counts) for _, field in types[name][1]))
    if counts[name] > _MOST_PARTS:
        raise RecordingError(f"{name}: got more parts, expected at most {_MOST_PARTS}")
    return counts[name]


def _parts(field: Any, types: dict[str, Any], counts: dict[str, int]) -> int:
    from rosbags.interfaces import Nodetype

    kind, inner = field
    if kind == Nodetype.BASE:
        return 1
    if kind == Nodetype.NAME:
        return _count(inner, types, counts)
    item, length = inner
    if kind == Nodetype.ARRAY and (item[0] == Nodetype.NAME or item[1][0] == "string"):
        return int(length) * _parts(item, types, counts)
    return _parts(item, types, counts)
