"""`python -m plow_twin` is the command `plow-twin`."""

from plow_twin.cli import main

main()
