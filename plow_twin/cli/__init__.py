"""The command `plow-twin`: verbs over the library, nothing else.

Exit codes: 0 done, 1 failed, 2 wrong usage or scene, 3 done with counted loss. Results go to standard output, progress
and errors to standard error.
"""

from plow_twin.cli.app import main as main
