"""Write the tables of pages and the files of `config` that are made from results or code: `python tools/pages.py`.

A page marks the place of a table by `<!-- made: NAME -->` and `<!-- end -->`; `TABLES[NAME]` makes the text between.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "benchmark"))

import figures  # noqa: E402
import reference  # noqa: E402

from plow_twin.live.diagnostics import keys_text  # noqa: E402
from plow_twin.live.parameters import yaml_text  # noqa: E402
from plow_twin.stream.topics import TOPICS  # noqa: E402

PAGES = (
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *(ROOT / "benchmark" / "results" / name for name in ("estimate_tables.md", "measured_tables.md", "tuning.md")),
)
TABLES: dict[str, Callable[[], str]] = {**figures.FIGURES, **reference.TABLES}
_BLOCK = re.compile(r"(<!-- made: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def renewed(text: str) -> str:
    """Return a page with its tables renewed."""
    return _BLOCK.sub(lambda block: f"{block[1]}\n{TABLES[block[2]]().strip()}\n\n{block[3]}", text)


def with_topics(policy: str) -> str:
    """Return the SROS2 policy with the topics of the table as the topics that the twin may publish."""
    names = "".join(f"            <topic>{topic.name}</topic>\n" for topic in TOPICS)
    first, last = '<topics publish="ALLOW">\n', "            <topic>markers</topic>"
    begin = policy.index(first, policy.index('<enclave path="/plow_twin/twin">')) + len(first)
    return policy[:begin] + names + policy[policy.index(last, begin) :]


def main() -> None:
    """Rewrite the pages, the files of parameters and of diagnostic keys, and the policy of SROS2."""
    for page in PAGES:
        page.write_text(renewed(page.read_text(encoding="utf-8")), encoding="utf-8")
    (ROOT / "config" / "twin.yaml").write_text(yaml_text(), encoding="utf-8")
    (ROOT / "config" / "diagnostics.yaml").write_text(keys_text(), encoding="utf-8")
    policy = ROOT / "config" / "sros2" / "policy.xml"
    policy.write_text(with_topics(policy.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
