"""`mampc replay`: a recorded trajectory decided again, by the regulator that its study describes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from mampc.base.checks import as_choice
from mampc.base.errors import MampcError
from mampc.loop.replay import Difference, Recording, replay
from mampc.report.output import trajectories
from mampc.study import Study
from mampc.study.regulators import regulator_of
from mampc.study.running import initial_state, prepare
from mampc.systems.state_space import StateSpace


def replay_trajectory(
    path: Path,
    study: Study,
    tolerance: float,
    on_stage: Callable[[str], None] = lambda stage: None,
    controller_name: str | None = None,
) -> tuple[int, Difference | None]:
    """Replay a file of `mampc run`; returns its number of samples and the first difference, if any.

    With the name of a controller, a file that a `Recorder` wrote of a live loop with that one.

    Raises:
        MampcError: a file that is not named as a trajectory of the study, or cannot be read.
    """
    files = {name: (scenario, controller) for scenario, controller, name in trajectories(study)}
    controllers = {table.name: table for table in study.controllers}
    if controller_name is not None:
        as_choice("controller", controller_name, controllers)
    if controller_name is None and path.name not in files:
        raise MampcError(
            f"replay: expected a file named one of {', '.join(files)}, received {path.name}; a live loop's needs "
            "--controller"
        )
    if not path.is_file():  # now rather than after a model has been identified
        raise MampcError(
            f"replay: expected a file that `mampc run` wrote, received {path}, where there is none"
        )
    beside = path.with_name("model.json")
    prepared = prepare(study, on_stage, StateSpace.load(beside) if beside.is_file() else None)
    scenario_name = None
    if controller_name is None:
        scenario_name, controller_name = files[path.name]
    regulator = regulator_of(study, prepared.model, controllers[controller_name])
    recording = Recording.from_csv(path, prepared.plant.names)
    if scenario_name is not None and len(recording.t) != study.steps:
        raise MampcError(f"{path}: expected the study's {study.steps} samples, received {len(recording.t)}")
    on_stage(f"replaying {len(recording.t)} samples")
    state = None
    if scenario_name is not None:
        scenario = next(table for table in study.scenarios if table.name == scenario_name)
        state = initial_state(study, prepared, scenario, regulator)
    difference = replay(regulator, state, recording, preview=study.reference.preview, tolerance=tolerance)
    return len(recording.t), difference
