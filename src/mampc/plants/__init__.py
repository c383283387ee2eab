"""Nonlinear plants with documented parameters, and what a plant of your own must have."""

from mampc.plants.integration import advance
from mampc.plants.plant import Plant
from mampc.plants.quadruple_tank import QuadrupleTank
from mampc.plants.sofc import SolidOxideFuelCell

__all__ = ["Plant", "QuadrupleTank", "SolidOxideFuelCell", "advance"]
