"""ROS domains that no other process of any test run on this machine uses."""

from __future__ import annotations

import fcntl
import os
import tempfile
from pathlib import Path

#: Domains 1 to 101 use no ephemeral ports.
_DOMAINS = range(1, 102)
_claimed: list[int] = []


def claim_domain() -> str:
    """Return the number of a free ROS domain, which stays claimed until this process and its forks have ended."""
    for offset in range(len(_DOMAINS)):
        domain = _DOMAINS[(os.getpid() + offset) % len(_DOMAINS)]
        path = Path(tempfile.gettempdir()) / f"plow_twin-ros-domain-{os.getuid()}-{domain}"
        file = os.open(path, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(file)
            continue
        _claimed.append(file)
        return str(domain)
    raise RuntimeError("ROS domains: got no free domain, expected a free one among 1 to 101")
