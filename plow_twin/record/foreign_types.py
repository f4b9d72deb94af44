"""Message types whose text is in a recording; parsing is bounded, because decoders are generated from the types."""

from __future__ import annotations

from typing import Any, Final

from plow_twin.errors import RecordingError

#: Largest length of the text of a type and its parts, without comments [characters]; usual texts have some 10,000.
_LONGEST: Final = 2**18
#: Largest number of parts (numbers, texts, arrays of numbers) of a message; a sequence counts as one item.
_MOST_PARTS: Final = 1_000


def parsed_types(text: str, message_type: str) -> dict[str, Any]:
    """Return the types in a `ros2msg` text.

    Raises
    ------
    RecordingError
        The text is too long, or the type contains itself or too many parts. The parser and the type store raise other
        errors for other bad texts.
    """
    from rosbags.typesys import get_types_from_msg

    # the parser's time grows with the square of the number of consecutive empty lines
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if sum(map(len, lines)) > _LONGEST:
        raise RecordingError(f"{message_type}: got a longer text, expected at most {_LONGEST} characters")
    types: dict[str, Any] = get_types_from_msg("\n".join(lines) + "\n", message_type)
    counts: dict[str, int] = {}
    for name in types:
        _count(name, types, counts)
    return types


def _count(name: str, types: dict[str, Any], counts: dict[str, int]) -> int:
    """Return the number of parts of a message; a type that is not in `types` is one part."""
    if name not in types:
        return 1
    if name not in counts:
        # until its parts are counted, a type counts as too large, so that a type that contains itself is refused
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
