"""Plants of a study: built-in by name, or a class of the user's as `module:Class`.

A study file is data. The one way it can run code is a plant named `module:Class`, and that is done only
for studies the user trusts: those within the current folder, or with `--trust` on the command line.
"""

from __future__ import annotations

import importlib
import sys
import traceback
from typing import Any

import numpy as np

from mampc.base.errors import MampcError, StudyError
from mampc.plants import Plant
from mampc.plants.plant import MEMBERS, missing_of
from mampc.study.schema import PLANTS, SAMPLED, Study
from mampc.systems.state_space import StateSpace


def make_plant(study: Study) -> Plant | StateSpace:
    """The plant that a study names, with its parameters.

    Raises:
        StudyError: an unknown module or class, code of a study not trusted, missing members or parameters
            that the class does not take.
    """
    kind = study.plant.kind
    maker = PLANTS[kind] if kind in PLANTS else _imported(study)
    sampled = {"dt": study.dt} if kind in SAMPLED else {}
    try:
        plant: Plant | StateSpace = maker(**study.plant.parameters, **sampled)
        missing = missing_of(plant)
    except TypeError as error:
        raise StudyError(f"plant.parameters: expected parameters of {kind}, received: {error}") from None
    except MampcError as error:
        raise StudyError(f"plant.parameters: {error}") from None
    except (Exception, SystemExit) as error:
        raise StudyError(f"plant.kind: expected that {kind} can be made, received {_told(error)}") from None
    if isinstance(plant, StateSpace):
        if not np.isclose(plant.dt, study.dt, rtol=1e-6):
            raise StudyError(f"dt: expected the {plant.dt:g} s of the plant {kind}, received {study.dt:g} s")
        return plant
    if missing:
        raise StudyError(
            f"plant.kind: expected a class with members {', '.join(MEMBERS)} (names a mampc.Names), "
            f"received {kind} without {missing}"
        )
    return plant


def _imported(study: Study) -> Any:
    """The class behind module:Class; its module may lie beside the study."""
    module_name, class_name = study.plant.kind.split(":")
    if not study.place.trusted:
        raise StudyError(
            f"plant.kind: {study.plant.kind!r} runs code, and this study is no file within the current folder; "
            "look at that code, then allow it with --trust (in Python trust=True)"
        )
    folder = str(study.place.folder)
    sys.path.insert(0, folder)
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise StudyError(f"plant.kind: expected a module that can be imported, received: {error}") from None
    except (Exception, SystemExit) as error:
        raise StudyError(
            f"plant.kind: expected a module that can be imported, received {_told(error)}"
        ) from None
    finally:
        sys.path.remove(folder)
    if not hasattr(module, class_name):
        raise StudyError(f"plant.kind: expected a class in {module_name}, received {class_name!r}")
    return getattr(module, class_name)


def _told(error: BaseException) -> str:
    """What went wrong in code of the user's, and where."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f", in line {frames[-1].lineno} of {frames[-1].filename}"
    return f"{type(error).__name__}: {error}{'' if isinstance(error, SyntaxError) else place}"
