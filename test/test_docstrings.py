"""The API reference is complete: it describes every parameter, field and result, with the shapes of arrays."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from typing import Any

import griffe
import pytest
from scenes import ROOT

#: Pattern of the declaration of a field that contains its unit and its meaning, which the site shows.
DECLARED = re.compile(r"_(quantity|choice)\(")
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
ARRAYS = re.compile(r"NDArray|ArrayLike|\bArray\b")


@pytest.fixture(scope="module")
def package() -> griffe.Module:
    return griffe.load("plow_twin", docstring_parser="numpy", search_paths=[str(ROOT)])


def public(package: griffe.Module) -> Iterator[tuple[str, Any]]:
    """Yield all public functions and classes, and the public methods and properties of these classes."""
    for name in re.findall(r"^::: plow_twin\.(\w+)$", (ROOT / "docs" / "api.md").read_text(), re.MULTILINE):
        item = package[name]
        item = item.final_target if item.is_alias else item
        if item.is_class or item.is_function:
            yield name, item
        if item.is_class:
            members = ((key, member) for key, member in item.members.items() if not key.startswith("_"))
            yield from ((f"{name}.{key}", member) for key, member in members if member.is_function)


def described(item: Any) -> dict[str, str]:
    """Return the type, shape and text of each parameter and attribute in a docstring."""
    descriptions = {}
    for section in item.docstring.parsed:
        if section.kind.value in ("parameters", "attributes"):
            for entry in section.value:
                descriptions |= {
                    name.strip(): f"{entry.annotation} {entry.description}" for name in entry.name.split(",")
                }
    return descriptions


def test_every_public_name_has_a_docstring(package: griffe.Module) -> None:
    names = [name for name, _ in public(package)]
    assert len(names) > 45
    assert [name for name, item in public(package) if item.docstring is None] == []


def test_every_parameter_is_described_and_every_result(package: griffe.Module) -> None:
    undescribed = []
    for name, function in public(package):
        if not function.is_function:
            continue
        docstring, text = described(function), function.docstring.value
        parameters = [p for p in function.parameters if p.name not in ("self", "cls")]
        undescribed += [f"{name}({p.name})" for p in parameters if p.name not in docstring]
        undescribed += [
            f"{name}({p.name}): no shape"
            for p in parameters
            if ARRAYS.search(str(p.annotation)) and "shape" not in docstring.get(p.name, "")
        ]
        summary = text.partition("\n\n")[0].lower()
        if str(function.returns) != "None" and "Returns\n" not in text and "return" not in summary:
            undescribed.append(f"{name}: the result")
    assert undescribed == []


def test_every_field_is_described(package: griffe.Module) -> None:
    undescribed = []
    for name, item in public(package):
        if not item.is_class:
            continue
        docstring = described(item)
        for key, field in item.members.items():
            if not field.is_attribute or key.startswith("_") or DECLARED.search(str(field.value)):
                continue
            if key not in docstring and field.docstring is None:
                undescribed.append(f"{name}.{key}")
            elif (
                ARRAYS.search(str(field.annotation))
                and "property" not in field.labels
                and "shape" not in docstring[key]
            ):
                undescribed.append(f"{name}.{key}: no shape")
    assert undescribed == []


def test_errors_that_a_function_raises_are_documented(package: griffe.Module) -> None:
    undescribed = []
    for name, function in public(package):
        if function.is_function:
            raised = {*re.findall(r"^ +raise (\w+)\(", function.source, re.MULTILINE)}
            docstring = function.docstring.value
            # ArgumentError is a ValueError, so a docstring that names ValueError covers it
            docstring += "ArgumentError" if "ValueError" in docstring else ""
            undescribed += [f"{name}: {error}" for error in raised if error not in docstring]
    assert undescribed == []


def test_every_described_parameter_exists() -> None:
    """A section `Parameters` names only arguments of its function, or of the constructor of its class."""
    mistakes = []
    for path in (ROOT / "plow_twin").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            section = re.search(
                r"^Parameters\n-+\n(.*?)(?:^\w+\n-+\n|\Z)",
                (ast.get_docstring(node) or "") if isinstance(node, DOCUMENTED) else "",
                re.MULTILINE | re.DOTALL,
            )
            if section is None:
                continue
            lines = re.findall(r"^(\S.*?)(?: : .*)?$", section[1], re.MULTILINE)
            names = {name.strip().lstrip("*") for line in lines for name in line.split(",")}
            mistakes += [f"{path.name}: {name}" for name in sorted(names - arguments(node))]
    assert mistakes == []


def arguments(node: ast.AST) -> set[str]:
    """Return the names of the arguments of a function, or of the constructor and the fields of a class."""
    functions = [node, *(part for part in getattr(node, "body", ()) if getattr(part, "name", "") == "__init__")]
    found = {argument.arg for function in functions for argument in ast.walk(getattr(function, "args", ast.Pass()))
             if isinstance(argument, ast.arg)}  # fmt: skip
    fields = [part.target for part in getattr(node, "body", ()) if isinstance(part, ast.AnnAssign)]
    return found | {field.id for field in fields if isinstance(field, ast.Name)}


def test_no_docstring_begins_with_an_empty_word() -> None:
    """A docstring begins with a verb or the name of its subject, for example `Return whether`, not `Tell whether`."""
    mistakes = []
    for folder in ("plow_twin", "test", "benchmark", "tools", "studies", "examples", "launch"):
        for path in (ROOT / folder).rglob("*.py"):
            nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, DOCUMENTED)]
            first = [(ast.get_docstring(node) or "-").split(maxsplit=1)[0] for node in nodes]
            mistakes += [f"{path.relative_to(ROOT)}: {word}" for word in first if word in ("What", "Tell", "Tells")]
    assert mistakes == []
