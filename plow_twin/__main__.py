"""Entry point of `python -m plow_twin`, which runs the command `plow-twin`."""

from plow_twin.cli import main

main()
