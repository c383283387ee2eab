"""Plants with documented parameters, and what a plant of your own must have."""

from mampc.plants.columns import ogunnaike_ray, wood_berry
from mampc.plants.integration import advance, state_sizes
from mampc.plants.level import Level
from mampc.plants.plant import Plant
from mampc.plants.quadruple_tank import QuadrupleTank
from mampc.plants.sofc import SolidOxideFuelCell
from mampc.plants.van_de_vusse import VanDeVusse

__all__ = [
    "Level",
    "Plant",
    "QuadrupleTank",
    "SolidOxideFuelCell",
    "VanDeVusse",
    "advance",
    "ogunnaike_ray",
    "state_sizes",
    "wood_berry",
]
