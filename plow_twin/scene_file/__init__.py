"""Conversion of scene files (YAML) to a `Scene` and back.

Scalars follow the YAML 1.2 core schema: `9.6975e6` is a number, and `on` is a text.
"""

from plow_twin.scene_file.reader import load_scene as load_scene
from plow_twin.scene_file.reader import loads_scene as loads_scene
from plow_twin.scene_file.schema import scene_schema as scene_schema
from plow_twin.scene_file.writer import dump_scene as dump_scene
