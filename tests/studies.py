"""Texts of studies: the built-in one, shorter and with other controllers, and one of a model beside it."""

from mampc.study import template

MPC_AND_PRICE = """
[[controllers]]
name = "MPC"
method = "mpc"

[[controllers]]
name = "exact"
method = "exact"
rules = { price = 1.0 }
"""


def short_study(tables, *, steps, until="[[controllers]]", **changed):
    """Its text up to a table, with so many steps and other values of keys, such as skip=(15, 0); then `tables`."""
    text = template()
    for key, (old, new) in ({"steps": (145, steps), "prbs_order": (8, 6)} | changed).items():
        assert f"{key} = {old}" in text
        text = text.replace(f"{key} = {old}", f"{key} = {new}")
    return text[: text.index(until)] + tables


def study_of_a_model(tables, *, steps):
    """A study of model.json with two inputs and outputs, whose scenarios and controllers are `tables`."""
    return f"""
name = "of a model"
steps = {steps}
dt = 1.0
plant = {{ kind = "model" }}
model = {{ file = "model.json" }}
[problem]
prediction_horizon = 8
control_horizon = 3
limits = {{ u_min = -5.0, u_max = 5.0 }}
[reference]
initial = [0.0, 0.0]
changes = [{{ at = 2, value = [1.0, 1.0] }}]
{tables}"""
