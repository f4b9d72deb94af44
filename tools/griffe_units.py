"""Extension of griffe: documents each field of a scene with its unit and text from the source."""

from __future__ import annotations

import ast
from typing import Any

from griffe import Attribute, Docstring, Extension


class Units(Extension):
    """Read `_quantity("kg", "mass", ...)`, `_choice("...", ...)` and `metadata={"doc": ...}` as docstrings."""

    def on_attribute_instance(self, *, attr: Attribute, **kwargs: Any) -> None:
        """Give a field without a docstring the text of its declaration as docstring."""
        if attr.docstring is None and attr.value is not None:
            call = ast.parse(str(attr.value), mode="eval").body
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name):
                text = _text(call.func.id, call)
                if text:
                    attr.docstring = Docstring(text, parent=attr, parser="numpy")
                    attr.value = None


def _text(function: str, call: ast.Call) -> str | None:
    words = [str(argument.value) for argument in call.args if isinstance(argument, ast.Constant)]
    if function == "_quantity":
        bounds = {word.arg: ast.unparse(word.value) for word in call.keywords}
        signs = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
        limits = ", ".join(f"{signs[name]} {value}" for name, value in bounds.items() if name in signs)
        arguments = [ast.unparse(argument) for argument in call.args[2:]]
        default = f"; {arguments[0]} unless given" if arguments and arguments[0] not in ("None", "math.nan") else ""
        return f"[{words[0]}] {words[1]}{default}{f' ({limits})' if limits else ''}"
    if function == "_choice":
        return f"{words[0]}{f'; {words[1]} unless given' if len(words) > 1 else ''}"
    return None
