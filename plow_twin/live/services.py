"""Services of a live twin. Each service returns whether it succeeded, and an answer."""

from __future__ import annotations

import json
from collections.abc import Callable

from plow_twin.live.parameters import services_off
from plow_twin.live.runtime import Runtime
from plow_twin.record.alarms import ACKNOWLEDGED, alarm_texts, alarms_message
from plow_twin.record.wear_state import check_depth
from plow_twin.stream.journal import Parameter, Snapshot


class Services:
    """Services of a live twin. Each method with a name in `SERVICES` is a service.

    The function `changed` is called when the state of the stream may have changed.
    """

    def __init__(self, runtime: Runtime, changed: Callable[[], None]) -> None:
        self._runtime, self._changed = runtime, changed
        self._snapshot: Snapshot | None = None

    def call(self, name: str, text: str | None = None) -> tuple[bool, str]:
        """Call the service `name`, unless the parameter `services_off` contains it; `text` is the text of a mark."""
        if name in services_off(self._runtime.settings):
            return False, f"{name}: switched off by the parameter services_off"
        if name == "mark":
            return self.mark(text)
        done: tuple[bool, str] = getattr(self, name)()
        return done

    def answer(self, action: str, text: str) -> tuple[bool, str]:
        """Answer the request `acknowledge` of an operator, or the request `mark` with a text."""
        return self.call("acknowledge_alarms" if action == "acknowledge" else "mark", text)

    def mark(self, text: str | None = None) -> tuple[bool, str]:
        """Write a text to the journal, and the ring of the recorder (the last seconds of the run) to the disk.

        The default text is the parameter `mark`.
        """
        return self._runtime.mark((self._runtime.settings.mark or "service") if text is None else text)

    def reset(self) -> tuple[bool, str]:
        """Reset the motion to its initial state."""
        self._runtime.driver.reset(self._runtime.stamp_ns, "service")
        self._changed()
        return True, "the motion is reset, the wear is not; the next sample has the model time 0"

    def snapshot(self) -> tuple[bool, str]:
        """Write the exact state to the journal, and store it for the service `restore`."""
        self._snapshot = self._runtime.driver.snapshot()
        return True, f"the state at {self._snapshot.stamp_ns} ns is stored, and written to the journal"

    def restore(self) -> tuple[bool, str]:
        """Restore the motion from the stored snapshot."""
        if self._snapshot is None:
            return False, "no snapshot has been taken since configure"
        self._runtime.driver.restore(self._runtime.stamp_ns, self._snapshot)
        self._changed()
        return (
            True,
            f"the motion at {self._snapshot.stamp_ns} ns is restored, the wear is not; the next sample continues it",
        )

    def acknowledge_alarms(self) -> tuple[bool, str]:
        """Release the latched alarms."""
        alarms = self._runtime.alarms
        active = alarms.acknowledge()
        self._runtime.driver.session.apply(Parameter(ACKNOWLEDGED, self._runtime.stamp_ns))
        self._runtime.send_alarms()
        values = dict(alarms_message(alarms, "", "").values)
        return True, f"still active: {'; '.join(alarm_texts(values, newest=True))}" if active else "no alarm is active"

    def forecast(self) -> tuple[bool, str]:
        """Return the last forecast as JSON."""
        if self._runtime.estimation is None or not any(self._runtime.settings.forecast_limits):
            return False, "no forecast is made: estimate is false or forecast_limits are 0"
        found = self._runtime.estimation.forecast
        return (True, json.dumps(found)) if found is not None else (False, self._runtime.estimation.forecast_error)

    def set_wear(self) -> tuple[bool, str]:
        """Set the wear of the pads to the parameter `set_wear`."""
        depth = self._runtime.settings.set_wear
        try:
            check_depth(depth, self._runtime.scene)
            self._runtime.driver.set_wear(self._runtime.stamp_ns, depth, "service")
        except ValueError as error:
            return False, f"parameter set_wear: {error}"
        self._runtime.save_wear()
        self._changed()
        return True, f"the pads are worn by {list(depth)} m from now on; the motion is reset"

    def switch_publisher(self) -> tuple[bool, str]:
        """Follow another sender of the load."""
        done = self._runtime.inputs.senders.switch()
        self._changed()
        if done:
            return True, f"the other publisher of {self._runtime.settings.excitation_source} is followed from now on"
        return False, f"no other publisher of {self._runtime.settings.excitation_source} has sent samples"
