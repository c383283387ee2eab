"""Plants with documented parameters, and what a plant of your own must have."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from mampc.plants.integration import advance, state_sizes
from mampc.plants.plant import Plant, require_plant

if TYPE_CHECKING:
    from mampc.plants.columns import ogunnaike_ray, wood_berry
    from mampc.plants.level import Level
    from mampc.plants.quadruple_tank import QuadrupleTank
    from mampc.plants.sofc import SolidOxideFuelCell
    from mampc.plants.van_de_vusse import VanDeVusse

_MODULE_OF = {
    "Level": "level", "QuadrupleTank": "quadruple_tank", "SolidOxideFuelCell": "sofc", "VanDeVusse": "van_de_vusse",
    "ogunnaike_ray": "columns", "wood_berry": "columns",
}  # fmt: skip

__all__ = [
    "Level",
    "Plant",
    "QuadrupleTank",
    "SolidOxideFuelCell",
    "VanDeVusse",
    "advance",
    "ogunnaike_ray",
    "require_plant",
    "state_sizes",
    "wood_berry",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'mampc.plants' has no attribute {name!r}")
    return getattr(import_module(f"mampc.plants.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
