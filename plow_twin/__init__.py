"""Digital twin of a mechanism with clearance: the coal plough's head in its guide."""

from __future__ import annotations

from importlib import import_module as _import_module
from typing import TYPE_CHECKING as _TYPE_CHECKING

if _TYPE_CHECKING:
    from plow_twin.errors import ArgumentError as ArgumentError
    from plow_twin.errors import LimitError as LimitError
    from plow_twin.errors import PlowTwinError as PlowTwinError
    from plow_twin.errors import Problem as Problem
    from plow_twin.errors import RecordingError as RecordingError
    from plow_twin.errors import RunInterrupted as RunInterrupted
    from plow_twin.errors import SceneError as SceneError
    from plow_twin.errors import SolverError as SolverError
    from plow_twin.errors import ToleranceWarning as ToleranceWarning
    from plow_twin.model.contact_laws import ContactLaw as ContactLaw
    from plow_twin.model.contact_laws import add_law as add_law
    from plow_twin.model.pairs import PAIR_NAMES as PAIR_NAMES
    from plow_twin.model.scene import Clearance as Clearance
    from plow_twin.model.scene import Constant as Constant
    from plow_twin.model.scene import Contact as Contact
    from plow_twin.model.scene import Frame as Frame
    from plow_twin.model.scene import Friction as Friction
    from plow_twin.model.scene import Gravity as Gravity
    from plow_twin.model.scene import Harmonic as Harmonic
    from plow_twin.model.scene import Head as Head
    from plow_twin.model.scene import Initial as Initial
    from plow_twin.model.scene import Mark as Mark
    from plow_twin.model.scene import Provenance as Provenance
    from plow_twin.model.scene import Scene as Scene
    from plow_twin.model.scene import Support as Support
    from plow_twin.model.scene import Table as Table
    from plow_twin.model.scene import Wear as Wear
    from plow_twin.record.recording import Recording as Recording
    from plow_twin.record.recording import read_recording as read_recording
    from plow_twin.run.advance import Advance as Advance
    from plow_twin.run.advance import AdvanceBatch as AdvanceBatch
    from plow_twin.run.advance import AdvanceSeries as AdvanceSeries
    from plow_twin.run.batch import TwinBatch as TwinBatch
    from plow_twin.run.energy_balance import EnergyBalance as EnergyBalance
    from plow_twin.run.ensemble import Ensemble as Ensemble
    from plow_twin.run.ensemble import simulate_many as simulate_many
    from plow_twin.run.sensitivity import Sensitivity as Sensitivity
    from plow_twin.run.sensitivity import sensitivity_parameters as sensitivity_parameters
    from plow_twin.run.simulate import Result as Result
    from plow_twin.run.simulate import simulate as simulate
    from plow_twin.run.twin import Status as Status
    from plow_twin.run.twin import Twin as Twin
    from plow_twin.run.twin_sensitivity import TwinSensitivity as TwinSensitivity
    from plow_twin.scene_file import dump_scene as dump_scene
    from plow_twin.scene_file import load_scene as load_scene
    from plow_twin.view.motion import plot_motion as plot_motion

#: Public names, grouped by the module that defines them. A module is imported when one of its names is first used.
#: Early imports would delay the handling of Ctrl-C, and would load the YAML reader for scenes that are built in Python.
_NAMES = {
    "plow_twin.errors": (
        "ArgumentError",
        "LimitError",
        "PlowTwinError",
        "Problem",
        "RecordingError",
        "RunInterrupted",
        "SceneError",
        "SolverError",
        "ToleranceWarning",
    ),
    "plow_twin.model.contact_laws": ("ContactLaw", "add_law"),
    "plow_twin.model.pairs": ("PAIR_NAMES",),
    "plow_twin.model.scene": (
        "Clearance",
        "Constant",
        "Contact",
        "Frame",
        "Friction",
        "Gravity",
        "Harmonic",
        "Head",
        "Initial",
        "Mark",
        "Provenance",
        "Scene",
        "Support",
        "Table",
        "Wear",
    ),
    "plow_twin.record.recording": ("Recording", "read_recording"),
    "plow_twin.run.advance": ("Advance", "AdvanceBatch", "AdvanceSeries"),
    "plow_twin.run.batch": ("TwinBatch",),
    "plow_twin.run.energy_balance": ("EnergyBalance",),
    "plow_twin.run.ensemble": ("Ensemble", "simulate_many"),
    "plow_twin.run.sensitivity": ("Sensitivity", "sensitivity_parameters"),
    "plow_twin.run.simulate": ("Result", "simulate"),
    "plow_twin.run.twin": ("Status", "Twin"),
    "plow_twin.run.twin_sensitivity": ("TwinSensitivity",),
    "plow_twin.scene_file": ("dump_scene", "load_scene"),
    "plow_twin.view.motion": ("plot_motion",),
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names}
#: Names for `import *`. Names that need the libraries of recordings or figures are excluded, because these libraries
#: may be missing.
__all__ = [name for name, module in _HOMES.items() if not module.startswith(("plow_twin.record", "plow_twin.view"))]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'plow_twin' has no attribute {name!r}")
    value = getattr(_import_module(_HOMES[name]), name)
    globals().setdefault(name, value)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
