"""Write the export of docs/data.md, an ugly one: `python docs/ugly_export.py export.csv`."""

import sys
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

import mampc

DT = 10.0
START = datetime(2024, 10, 27, 0, 40)  # the night in which summer time ends in Germany
CLOCKS_BACK = datetime(2024, 10, 27, 3, 0)
HEAD = """Werk 3, Export vom 28.10.2024

Zeitstempel;PU-1.OP;PU-2.OP;LI-1.PV;LI-2.PV;TI-9.PV;Status
;Pumpe links;Pumpe rechts;Füllstand links;Füllstand rechts;Raumtemperatur;
;%;%;cm;cm;°C;
"""


def ugly_export():
    """The text of the export: the quadruple tank under a test signal, as a historian may write it."""
    rng = np.random.default_rng(4)
    plant = mampc.plants.QuadrupleTank()
    u = mampc.prbs(order=8, amplitude=20.0, hold=5, mean=plant.u_op, inputs=2)
    data = mampc.excite(plant, u, dt=DT, noise=0.05, seed=1)
    lines = []
    for k, (inputs, levels) in enumerate(zip(data.u, data.y, strict=True)):
        moment = START + timedelta(seconds=k * DT)
        if moment >= CLOCKS_BACK:
            moment -= timedelta(hours=1)
        cells = [f"{value:.2f}".replace(".", ",") for value in (*inputs, *levels, 18 + rng.normal(0, 0.3))]
        state = "Good"
        if k in (333, 334, 701):
            cells[2 + k % 2] = "I/O Timeout"
        elif k == 950:
            cells[3] = "-9999"
        elif k == 404:
            state = "Uncertain"
        if not 500 <= k < 530:
            lines.append(";".join([f"{moment:%d.%m.%Y %H:%M:%S}", *cells, state]))
    lines.insert(100, lines[99])
    return HEAD + "\n".join(lines) + "\n"


if __name__ == "__main__":
    Path(sys.argv[1]).write_bytes(ugly_export().encode("cp1252"))
