"""Reader and writer of YAML. The reader limits size and nesting, because files may be malicious.

Scalars follow the YAML 1.2 core schema. The limits are checked on the events of the parser, before a document is built,
because libyaml recurses in C, and a few aliases can expand to any number of values.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import yaml

from plow_twin.errors import Problem
from plow_twin.scene_file.csv_rows import kind_of

try:  # libyaml is ten times faster for recorded tables, but PyYAML may be built without it
    from yaml import CSafeDumper as _Dumper
    from yaml import CSafeLoader as _Loader
except ImportError:
    from yaml import SafeDumper as _Dumper  # type: ignore[assignment]
    from yaml import SafeLoader as _Loader  # type: ignore[assignment]

#: Size [B] of the largest accepted file, enough for a table of 200,000 rows. Longer tables belong in CSV files.
LARGEST_FILE: Final = 64 * 2**20
MOST_VALUES: Final = 1_000_000
#: Largest nesting depth of collections. A scene has six levels.
DEEPEST: Final = 20
#: Largest number of keys of a document. The `metadata.yaml` of a recording with 1,000 parts has 20,000 keys.
MOST_KEYS: Final = 50_000
#: Largest number of values to which all aliases of a document may expand.
MOST_REPEATED: Final = 50_000

_FLOAT: Final = re.compile(r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.inf|\.nan)$", re.I)
# tag, pattern and possible first characters; the first matching pattern determines the type
_CORE_SCHEMA: Final = (
    ("tag:yaml.org,2002:null", re.compile(r"^(?:~|null|Null|NULL|)$"), ["~", "n", "N", ""]),
    ("tag:yaml.org,2002:bool", re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$"), list("tTfF")),
    ("tag:yaml.org,2002:int", re.compile(r"^[-+]?[0-9]+$"), list("-+0123456789")),
    ("tag:yaml.org,2002:float", _FLOAT, list("-+.0123456789")),
    ("tag:yaml.org,2002:merge", re.compile(r"^<<$"), ["<"]),
)


class SceneLoader(_Loader):
    """Safe loader for scalars of the YAML 1.2 core schema."""

    # PyYAML follows YAML 1.1, in which 1e6 is a text, `on` a bool, 010 the number 8, and 1:30 the number 90
    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012


class SceneDumper(_Dumper):
    """Safe dumper that quotes each text that YAML 1.1 or 1.2 would not read as text."""

    def ignore_aliases(self, data: Any) -> bool:
        """Return True, so that no aliases are written."""
        return True


for _tag, _pattern, _first in _CORE_SCHEMA:
    SceneLoader.add_implicit_resolver(_tag, _pattern, _first)
SceneLoader.add_constructor("tag:yaml.org,2002:int", lambda _, node: int(node.value))
SceneDumper.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+.0123456789"))


def read_yaml(path: Path, name: str, sections: str) -> tuple[Any, list[Problem]]:
    """Read a YAML file of at most `LARGEST_FILE` bytes and `MOST_VALUES` values. Return its document and its problems.

    The arguments after the path are those of `load_yaml`.
    """
    try:
        with path.open("rb") as stream:
            data = stream.read(LARGEST_FILE + 1)
        if len(data) > LARGEST_FILE:
            return None, [Problem("file", str(path), f"at most {LARGEST_FILE >> 20} MiB of YAML")]
        text = data.decode("utf-8-sig")
    except OSError as error:
        return None, [Problem("file", str(path), f"a readable {name} file ({error.strerror})")]
    except UnicodeDecodeError:
        kind = kind_of(data)
        reason = f"it is {kind}" if kind else "not UTF-8"
        return None, [Problem("file", str(path), f"a readable {name} file ({reason})")]
    return load_yaml(text, name, sections, most_values=MOST_VALUES)


def load_yaml(text: str, name: str, sections: str, *, most_values: float = math.inf) -> tuple[Any, list[Problem]]:
    """Return a document and its problems. An unreadable document is None. Messages call the document `name`."""
    try:
        excess = _excess(text, most_values)
        if excess is not None:
            return None, [excess]
        loader = SceneLoader(text)
        try:
            node = loader.get_single_node()
            if node is None:
                return None, [Problem(name, "an empty file", sections)]
            problems = list(_repeated_keys(node, ""))
            return loader.construct_document(node), problems
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        return None, [Problem(_place(mark) if mark else name, str(error.problem), "YAML")]
    except yaml.YAMLError as error:
        return None, [Problem(name, " ".join(str(error).split()), "YAML")]
    except ValueError as error:  # Python rejects integers with thousands of digits
        return None, [Problem(name, str(error), "numbers")]


@dataclass
class _Size:
    """Size of a node including its children. The size of an alias is the size of the repeated node."""

    values: int = 1
    keys: int = 0
    depth: int = 0


def _excess(text: str, most_values: float) -> Problem | None:
    """Return a problem if the events of a document exceed a limit, otherwise None. YAML errors are raised."""
    scalar = _Size()
    values = repeated = 0
    sizes: dict[str, _Size | None] = {}  # size of each node with an anchor; None until the node ends
    outer, is_mapping, anchor = _Size(), False, None
    stack: list[tuple[_Size, bool, str | None]] = []  # size, kind and anchor of each enclosing collection
    event: Any
    for event in yaml.parse(text, SceneLoader):
        kind = type(event)
        node, depth = scalar, len(stack)
        if kind is yaml.ScalarEvent:
            if event.anchor:
                sizes[event.anchor] = scalar
        elif kind is yaml.SequenceStartEvent or kind is yaml.MappingStartEvent:
            stack.append((outer, is_mapping, anchor))
            outer, is_mapping, anchor = _Size(), kind is yaml.MappingStartEvent, event.anchor
            if anchor:
                sizes[anchor] = None
            if len(stack) > DEEPEST:
                return _above(event, len(stack), DEEPEST, "levels of nesting")
            continue
        elif kind is yaml.SequenceEndEvent or kind is yaml.MappingEndEvent:
            node = outer
            if anchor:
                sizes[anchor] = outer
            outer, is_mapping, anchor = stack.pop()
        elif kind is yaml.AliasEvent:
            size = sizes.get(event.anchor, scalar)  # the composer reports an alias without an anchor
            if size is None:
                return Problem(_place(event.start_mark), "an alias to itself", "an alias to an earlier node")
            node = size
            repeated += node.values
            if repeated > MOST_REPEATED:
                return _above(event, repeated, MOST_REPEATED, "values by aliases")
            if depth + node.depth > DEEPEST:
                return _above(event, depth + node.depth, DEEPEST, "levels of nesting")
        else:
            continue
        values += 1
        if values > most_values:
            return _above(event, values, most_values, "values", " (a longer table can be in a csv file)")
        outer.values += node.values
        if is_mapping:
            outer.keys += 1
        outer.keys += node.keys
        if outer.keys > 2 * MOST_KEYS:  # `keys` counts the key and the value of each item
            return _above(event, (outer.keys + 1) // 2, MOST_KEYS, "keys")
        if outer.depth <= node.depth:
            outer.depth = node.depth + 1
    return None


def _above(event: Any, got: int, most: float, unit: str, more: str = "") -> Problem:
    return Problem(_place(event.start_mark), f"{got} {unit}", f"at most {most} {unit}{more}")


def _place(mark: Any) -> str:
    return f"line {mark.line + 1}, column {mark.column + 1}"


def dump_yaml(data: Any, *, flow: bool = True) -> str:
    """Return plain data as YAML text. Floats are written by repr, so that reading the text gives bit-identical numbers.

    With `flow`, collections of scalars are written in brackets.
    """
    style = None if flow else False
    return yaml.dump(data, Dumper=SceneDumper, sort_keys=False, default_flow_style=style, allow_unicode=True, width=120)


def _repeated_keys(node: yaml.Node, path: str) -> Iterator[Problem]:
    if isinstance(node, yaml.SequenceNode):
        for index, item in enumerate(node.value):
            if not isinstance(item, yaml.ScalarNode):
                yield from _repeated_keys(item, f"{path}[{index}]")
    elif isinstance(node, yaml.MappingNode):
        lines: dict[str, int] = {}
        for key, value in node.value:
            name = str(key.value)
            key_path = f"{path}.{name}" if path else name
            line = key.start_mark.line + 1
            if name in lines:
                yield Problem(key_path, f"the key twice, in lines {lines[name]} and {line}", "each key once")
            lines[name] = line
            yield from _repeated_keys(value, key_path)
