"""Two distillation columns, as transfer functions with dead times; as models they are exact at the samples."""

from __future__ import annotations

import numpy as np

from mampc.base.checks import as_number
from mampc.base.names import Names
from mampc.systems.pairs import Pair, joined, transfer
from mampc.systems.state_space import StateSpace

MINUTE = 60.0  # seconds

# Gain, lead and lags, dead time; times in minutes.
Entry = tuple[float, tuple[float, ...], tuple[float, ...], float]


def wood_berry(dt: float = 60.0) -> StateSpace:
    """The methanol-water column of Wood and Berry: two products, reflux and steam; the feed is measured.

    Outputs are the weight percentages of methanol in distillate and bottoms (usually 96.0 and 0.5), inputs the flows of
    reflux and steam, the disturbance the feed flow, in lb/min (1.95, 1.71 and 2.45). Sensible limits are 0 to twice
    that, sensible noise is 0.05 %. Dead times of 1 to 8 minutes; strong interaction.

    Args:
        dt: sample time in seconds.

    Source: Wood, Berry: Terminal composition control of a binary distillation column, Chemical Engineering Science 28
    (1973).
    """
    entries: list[list[Entry]] = [
        [(12.8, (), (16.7,), 1.0), (-18.9, (), (21.0,), 3.0), (3.8, (), (14.9,), 8.1)],
        [(6.6, (), (10.9,), 7.0), (-19.4, (), (14.4,), 3.0), (4.9, (), (13.2,), 3.4)],
    ]
    names = Names(
        ("reflux", "steam"), ("distillate", "bottoms"), disturbances=("feed",),
        units={"reflux": "lb/min", "steam": "lb/min", "feed": "lb/min", "distillate": "%", "bottoms": "%"},
    )  # fmt: skip
    return _model(entries, dt, names, u_op=[1.95, 1.71], y_op=[96.0, 0.5], v_op=[2.45])


def ogunnaike_ray(dt: float = 60.0) -> StateSpace:
    """The ethanol-water column with a side stream of Ogunnaike and Ray: three inputs, three outputs.

    Outputs are the mole fractions of ethanol overhead and in the side stream and the temperature of tray 19 in degrees
    Celsius (usually 0.7, 0.52 and 92), inputs the flows of reflux and side stream in gal/min and the steam pressure of
    the reboiler in psi (0.18, 0.046 and 20), measured disturbances the feed's flow in gal/min and temperature in
    degrees Celsius (0.8 and 78). Sensible limits are 0 to twice the usual inputs, sensible noise is 0.001, 0.001 and
    0.1. Dead times of 1 to 12 minutes, and units far apart.

    Args:
        dt: sample time in seconds.

    Source: Ogunnaike, Lemaire, Morari, Ray: Advanced multivariable control of a pilot-plant distillation column, AIChE
    Journal 29 (1983). A second source confirms the gains and lags of all inputs, and all their dead times but two: for
    those from the two flows to the temperature (9.2 and 9.4) it has 7. The responses to the feed have no second source.
    """
    entries: list[list[Entry]] = [
        [
            (0.66, (), (6.7,), 2.6), (-0.61, (), (8.64,), 3.5), (-0.0049, (), (9.06,), 1.0),
            (0.14, (), (6.2,), 12.0), (-0.0011, (26.32,), (7.85, 14.63), 2.66),
        ],
        [
            (1.11, (), (3.25,), 6.5), (-2.36, (), (5.0,), 3.0), (-0.012, (), (7.09,), 1.2),
            (0.53, (), (6.9,), 10.5), (-0.0032, (19.62,), (7.29, 8.94), 3.44),
        ],
        [
            (-34.68, (), (8.15,), 9.2), (46.2, (), (10.9,), 9.4), (0.87, (11.61,), (3.89, 18.8), 1.0),
            (-11.54, (), (7.01,), 0.6), (0.32, (), (7.76,), 2.6),
        ],
    ]  # fmt: skip
    names = Names(
        ("reflux", "side_stream", "steam"), ("overhead", "side", "tray_19"),
        disturbances=("feed", "feed_temperature"),
        units={
            "reflux": "gal/min", "side_stream": "gal/min", "steam": "psi", "tray_19": "°C", "feed": "gal/min",
            "feed_temperature": "°C",
        },
    )  # fmt: skip
    return _model(entries, dt, names, u_op=[0.18, 0.046, 20.0], y_op=[0.7, 0.52, 92.0], v_op=[0.8, 78.0])


def _model(
    entries: list[list[Entry]],
    dt: float,
    names: Names,
    u_op: list[float],
    y_op: list[float],
    v_op: list[float],
) -> StateSpace:
    dt = as_number("dt", dt, 0.0, exclusive=True)
    pairs = [[_pair(entry, dt) for entry in row] for row in entries]
    A, B, C, D = joined(pairs)
    return StateSpace(A, B, C, D, dt, np.array(u_op), np.array(y_op), names, np.array(v_op))


def _pair(entry: Entry, dt: float) -> Pair:
    gain, leads, lags, dead_time = entry
    numerator, denominator = (np.poly([-1 / (time * MINUTE) for time in times]) for times in (leads, lags))
    scale = gain * np.prod(leads) / np.prod(lags) * MINUTE ** (len(leads) - len(lags))
    return transfer((scale * np.atleast_1d(numerator)).tolist(), denominator.tolist(), dead_time * MINUTE, dt)
