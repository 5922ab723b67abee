"""What a Mitsuba scene says: faces, materials, lamps, the oriented patches made of them, and rays between those."""

from .lights import LIGHTS, Light
from .materials import Finding, inspect
from .meshes import build_mesh
from .model import Model
from .state import refuse_gradients
from .tessellate import MESHERS, mesher

__all__ = ["LIGHTS", "MESHERS", "Finding", "Light", "Model", "build_mesh", "inspect", "mesher", "refuse_gradients"]
