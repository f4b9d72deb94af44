"""Import of Python modules that define contact laws. The modules are named in a command, never in a file."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Iterable
from pathlib import Path

from plow_twin.errors import InputError, Problem

_loaded: list[str] = []


def load_laws(names: Iterable[str]) -> None:
    """Import modules that add contact laws by `add_law`.

    A name is the path of a file that ends in .py, or the name of an installed module.

    Raises
    ------
    InputError
        A module cannot be imported, or it adds no law.
    """
    from plow_twin.model.contact_laws import LAWS

    for name in names:
        key = str(Path(name).resolve()) if name.endswith(".py") else name
        if key in _loaded:
            continue
        before = set(LAWS)
        try:
            _import_file(Path(key)) if name.endswith(".py") else importlib.import_module(name)
        except Exception as error:  # a module can raise any exception
            raise InputError([Problem("module", name, f"a module that can be imported ({error})")], "--laws") from error
        if set(LAWS) == before:
            raise InputError([Problem("module", name, "a module that calls plow_twin.add_law")], "--laws")
        _loaded.append(key)


def loaded_laws() -> tuple[str, ...]:
    """Return the names of the imported modules, so that child processes can import the same modules."""
    return tuple(_loaded)


def _import_file(path: Path) -> None:
    spec = importlib.util.spec_from_file_location(f"plow_twin_laws_{path.stem}", path)
    assert spec is not None and spec.loader is not None, "the name ends in .py"
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
