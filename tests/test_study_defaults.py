"""What a study file leaves out is what the classes leave out."""

import inspect

import numpy as np
import pytest

import mampc
from mampc.study.scenario_tables import ScenarioTable
from mampc.study.schema import (
    ControllerTable,
    EstimatorTable,
    IdentificationTable,
    LimitsTable,
    ProblemTable,
    RulesTable,
    SensorsTable,
)

ELSEWHERE = {"disturbance_at", "name", "rules", "method", "settings", "published", "limits", "manual"}
# A study samples a plant without feedthrough; a record from elsewhere may have one.
ELSEWHERE |= {"feedthrough"}
PAIRS = [
    (ProblemTable, mampc.TrackingProblem),
    (LimitsTable, mampc.Limits),
    (RulesTable, mampc.MoveRules),
    (EstimatorTable, mampc.KalmanFilter.offset_free),
    (SensorsTable, mampc.SensorChecks),
    (SensorsTable, mampc.Regulator),
    (ControllerTable, mampc.MAMPC),
    (IdentificationTable, mampc.n4sid),
    (ScenarioTable, mampc.simulate),
]


@pytest.mark.parametrize(("table", "made"), PAIRS, ids=lambda pair: pair.__qualname__)
def test_a_table_has_the_defaults_of_what_it_is_made_into(table, made):
    parameters = inspect.signature(made).parameters
    shared = (set(table.model_fields) & set(parameters)) - ELSEWHERE
    assert shared
    for name in shared:
        field, default = table.model_fields[name], parameters[name].default
        if field.is_required():
            assert default is inspect.Parameter.empty, name
        else:
            assert np.array_equal(field.default, default), (name, field.default, default)


def test_a_file_cannot_say_where_it_comes_from():
    text = 'place = "here"\n' + mampc.study.template()
    with pytest.raises(mampc.StudyError, match="place: unknown key"):
        mampc.study.parse_study(text)
