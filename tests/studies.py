"""The built-in study, shorter and with other controllers."""

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
    for key, (old, new) in ({"steps": (145, steps)} | changed).items():
        assert f"{key} = {old}" in text
        text = text.replace(f"{key} = {old}", f"{key} = {new}")
    return text[: text.index(until)] + tables
