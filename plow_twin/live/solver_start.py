"""Load the scene and compile the solver in a thread, so that the node can answer during the compilation."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Final, Literal

from plow_twin.errors import PlowTwinError
from plow_twin.live.parameters import Settings
from plow_twin.model.scene import Scene
from plow_twin.run.twin import Twin
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.presets import scene_path
from plow_twin.stream import session
from plow_twin.stream.driven import MOST_STEPS, Driven

#: Interval between checks for a requested stop [s].
_LOOK_S: Final = 0.05
_started: list[Future[Prepared]] = []


class StartAbandoned(PlowTwinError):
    """A stop was requested while the solver was compiled."""


@dataclass(frozen=True)
class Prepared:
    """A scene, its twin with compiled kernels, and the time of compilation [s]."""

    scene: Scene
    twin: Driven
    compile_s: float


class Preparation:
    """Preparation of a twin in a thread, in which `warm_up` compiles additional kernels."""

    def __init__(self, settings: Settings, warm_up: Callable[[], None] = lambda: None) -> None:
        self.key = key(settings)
        compiler = ThreadPoolExecutor(1, thread_name_prefix="compiler")
        self._future = compiler.submit(_prepare, settings, warm_up)
        compiler.shutdown(wait=False)
        _started[:] = [future for future in _started if not future.done()]
        _started.append(self._future)

    @property
    def done(self) -> bool:
        """Whether the method `result` returns without waiting."""
        return self._future.done()

    def result(self, stop_asked: Callable[[], bool]) -> Prepared:
        """Wait for the twin and return it.

        Raise `SceneError` or `OSError` if the scene is invalid or cannot be read, and `StartAbandoned` if a stop was
        requested. The compilation cannot be interrupted and continues in its thread.
        """
        while not wait((self._future,), _LOOK_S).done:
            if stop_asked():
                raise StartAbandoned("a stop was requested while the solver was compiled")
        return self._future.result()


def key(settings: Settings) -> tuple[object, ...]:
    """Return the settings on which a prepared twin depends, with the time and size of the scene file."""
    follow = settings.follows, settings.follow_members
    own = settings.scene, settings.tolerance, settings.excitation_source, settings.max_evaluations, *follow
    try:
        status = os.stat(scene_path(settings.scene))
    except (OSError, PlowTwinError):
        return own
    return *own, status.st_mtime_ns, status.st_size


def _prepare(settings: Settings, warm_up: Callable[[], None]) -> Prepared:
    scene = load_scene(scene_path(settings.scene))
    own = settings.excitation_source == "scene"
    twin: Driven
    if settings.follows != "off" and not own:
        from plow_twin.estimate.follow import follower

        twin = follower(scene, settings.follows, settings.follow_members, settings.tolerance)
    else:
        bound = settings.max_evaluations or None
        excitation: Literal["scene", "sampled"] = "scene" if own else "sampled"
        twin = Twin(scene, tol=settings.tolerance, excitation=excitation, max_evaluations=bound, max_steps=MOST_STEPS)
    compile_s = twin.warm_up()
    session.warm_up()
    warm_up()
    return Prepared(scene, twin, compile_s)


def leave(code: int, *, at_once: bool = False) -> int:
    """Return `code`, or end the process at once if `at_once` is True or a running compilation would delay the end."""
    if at_once:  # standard output has no reader, so it is not flushed
        os._exit(code)
    if all(future.done() for future in _started):
        return code
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
