"""Digital twin of a mechanism with clearance: the coal plough's head in its guide."""

from plow_twin.errors import PlowTwinError as PlowTwinError
from plow_twin.errors import Problem as Problem
from plow_twin.errors import RecordingError as RecordingError
from plow_twin.errors import SceneError as SceneError
from plow_twin.errors import SolverError as SolverError
from plow_twin.model.pairs import PAIR_NAMES as PAIR_NAMES
from plow_twin.model.scene import Clearance as Clearance
from plow_twin.model.scene import Constant as Constant
from plow_twin.model.scene import Contact as Contact
from plow_twin.model.scene import Frame as Frame
from plow_twin.model.scene import Gravity as Gravity
from plow_twin.model.scene import Harmonic as Harmonic
from plow_twin.model.scene import Head as Head
from plow_twin.model.scene import Initial as Initial
from plow_twin.model.scene import Mark as Mark
from plow_twin.model.scene import Provenance as Provenance
from plow_twin.model.scene import Scene as Scene
from plow_twin.model.scene import Table as Table
from plow_twin.model.scene import Wear as Wear
from plow_twin.simulate import Result as Result
from plow_twin.simulate import simulate as simulate
from plow_twin.twin import Advance as Advance
from plow_twin.twin import AdvanceSeries as AdvanceSeries
from plow_twin.twin import Status as Status
from plow_twin.twin import Twin as Twin
