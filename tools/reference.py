"""Tables of the reference pages, made from the code: topics, priors and contact laws."""

from __future__ import annotations

import textwrap
from collections.abc import Callable

from plow_twin.estimate.priors import DEFAULTS
from plow_twin.model.contact_laws import LAWS
from plow_twin.model.scene import Mark
from plow_twin.stream.topics import JOINT_STATE, TOPICS


def topics() -> str:
    """Return the topics that a twin sends: name, type unless it is a JointState, when they are sent, and content."""
    lines = []
    for topic in TOPICS:
        kind = "" if topic.type == JOINT_STATE else f"{topic.type.replace('/msg/', '/')}, "
        sent = f"{kind}{topic.cadence.value}{', latched' * topic.latched}"
        line = f"- `{topic.name}` ({sent}): {topic.content}"
        lines += textwrap.wrap(line, 140, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
    return "\n".join(lines)


def priors() -> str:
    """Return the prior's standard deviations of a scene's numbers, by mark."""
    marks = (Mark.MEASURED, Mark.GIVEN, Mark.RECONSTRUCTED, Mark.ASSUMED)
    lines = ["| number | " + " | ".join(mark.value for mark in marks) + " |", "|---" * (1 + len(marks)) + "|"]
    for name, by_mark in DEFAULTS.items():
        lines.append(f"| {name} | " + " | ".join(f"{by_mark[mark]:g}" for mark in marks) + " |")
    return "\n".join(lines)


def contact_laws() -> str:
    """Return the contact laws of the package with equation and source."""
    return "\n".join(f"- `{name}`: {law.source}" for name, law in LAWS.items())


TABLES: dict[str, Callable[[], str]] = {"topics": topics, "priors": priors, "contact_laws": contact_laws}
