"""YAML for scene files: safe, numbers by the YAML 1.2 core schema, repeated keys found, floats written exactly."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, Final

import yaml

from plow_twin.errors import Problem

try:  # libyaml where PyYAML was built with it: ten times faster on recorded tables
    from yaml import CSafeDumper as _Dumper
    from yaml import CSafeLoader as _Loader
except ImportError:
    from yaml import SafeDumper as _Dumper  # type: ignore[assignment]
    from yaml import SafeLoader as _Loader  # type: ignore[assignment]

#: A scene is nested about six deep; more is an alias to itself.
_MAX_DEPTH: Final = 20

_FLOAT: Final = re.compile(r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.inf|\.nan)$", re.I)
# tag, pattern, first characters; the first match decides
_CORE_SCHEMA: Final = (
    ("tag:yaml.org,2002:null", re.compile(r"^(?:~|null|Null|NULL|)$"), ["~", "n", "N", ""]),
    ("tag:yaml.org,2002:bool", re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$"), list("tTfF")),
    ("tag:yaml.org,2002:int", re.compile(r"^[-+]?[0-9]+$"), list("-+0123456789")),
    ("tag:yaml.org,2002:float", _FLOAT, list("-+.0123456789")),
    ("tag:yaml.org,2002:merge", re.compile(r"^<<$"), ["<"]),
)


class SceneLoader(_Loader):
    """Safe loader with the scalars of the YAML 1.2 core schema."""

    # PyYAML's own table is YAML 1.1: 1e6 a text, `on` a bool, 010 eight, 1:30 ninety
    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012


class SceneDumper(_Dumper):
    """Safe dumper that quotes whatever YAML 1.1 or 1.2 would take for something else than a text."""

    def ignore_aliases(self, data: Any) -> bool:
        """Write equal values out each time."""
        return True


for _tag, _pattern, _first in _CORE_SCHEMA:
    SceneLoader.add_implicit_resolver(_tag, _pattern, _first)
SceneLoader.add_constructor("tag:yaml.org,2002:int", lambda _, node: int(node.value))
SceneDumper.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+.0123456789"))


def load_yaml(text: str, name: str = "scene", sections: str = "the sections of a scene") -> tuple[Any, list[Problem]]:
    """Return the document and its problems, which call it by `name`; it is None when it cannot be read at all."""
    try:
        loader = SceneLoader(text)
        try:
            node = loader.get_single_node()
            if node is None:
                return None, [Problem(name, "an empty file", sections)]
            problems = list(_repeated_keys(node, "", 0))
            if any(problem.got == "an alias to itself" for problem in problems):
                return None, problems
            return loader.construct_document(node), problems
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1}, column {mark.column + 1}" if mark else name
        return None, [Problem(where, str(error.problem), "YAML")]
    except yaml.YAMLError as error:
        return None, [Problem(name, " ".join(str(error).split()), "YAML")]
    except ValueError as error:  # an integer of thousands of digits
        return None, [Problem(name, str(error), "numbers")]


def dump_yaml(data: Any) -> str:
    """Return plain data as YAML text; floats by repr, so that reading them back gives the same bits."""
    return yaml.dump(data, Dumper=SceneDumper, sort_keys=False, default_flow_style=None, allow_unicode=True, width=120)


def _repeated_keys(node: yaml.Node, path: str, depth: int) -> Iterator[Problem]:
    if depth > _MAX_DEPTH:
        yield Problem(path, "an alias to itself", f"nesting of at most {_MAX_DEPTH}")
    elif isinstance(node, yaml.SequenceNode):
        # the rows of long tables hold no mappings
        for index, item in enumerate(node.value):
            if not isinstance(item, yaml.ScalarNode):
                yield from _repeated_keys(item, f"{path}[{index}]", depth + 1)
    elif isinstance(node, yaml.MappingNode):
        lines: dict[str, int] = {}
        for key, value in node.value:
            name = str(key.value)
            here = f"{path}.{name}" if path else name
            line = key.start_mark.line + 1
            if name in lines:
                yield Problem(here, f"the key twice, in lines {lines[name]} and {line}", "each key once")
            lines[name] = line
            yield from _repeated_keys(value, here, depth + 1)
