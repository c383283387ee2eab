"""Rivals in study files."""

import pytest

import mampc
from mampc.study import parse_study, run_study, template

RIVALS = """
[[controllers]]
name = "dead band"
method = "dead_band"
settings = { size = 1.0 }

[[controllers]]
name = "l1 on moves"
method = "penalised"
settings = { penalty = "l1", weight = 2.0 }

[[controllers]]
name = "rounded exact"
method = "rounded"
settings = { step = 0.5 }
around = "exact"
rules = { price = 1.0 }
"""


def study(controllers):
    text = template()
    start = text.index("[[controllers]]")
    text = text[:start].replace("steps = 145", "steps = 30").replace("prbs_order = 8", "prbs_order = 6")
    return parse_study(text + controllers)


def test_a_study_runs_rivals_beside_each_other():
    found = run_study(study(RIVALS).model_copy(update={"steps": 30, "skip": 0}))
    for runs in found.runs.values():
        assert list(runs) == ["dead band", "l1 on moves", "rounded exact"]
        assert all((run.u >= 0).all() for run in runs.values())


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ('method = "dead_bend"', "dead_band"),
        ('method = "dead_band"', "size"),
        ('method = "dead_band"\nsettings = { size = 1.0, sise = 2.0 }', "expected settings among size, kind"),
        ('method = "penalised"\nsettings = { penalty = "l3" }', "penalty: expected one of l1"),
        ('method = "penalised"\nsettings = { penalty = ["l1"] }', "penalty: expected one of l1"),
        ('method = "rounded"\nsettings = { step = 1.0 }\naround = "exact"', "rules for what a rule"),
        ('method = "mpc"\naround = "exact"', "around with the rules"),
    ],
)
def test_what_is_wrong_with_a_rival_is_said(table, expected):
    with pytest.raises(mampc.StudyError, match=expected):
        study(f'[[controllers]]\nname = "x"\n{table}\n')
