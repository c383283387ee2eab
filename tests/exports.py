"""Exports as plants produce them, generated with the truth beside them."""

import csv
import datetime
import io
from dataclasses import dataclass

import numpy as np

WORDS = (
    "Bad", "No Data", "I/O Timeout", "", "NaN", "Inf", "#N/A", "Comm Fail", "-",
    "[-11059] No Good Data For Calculation",
)  # fmt: skip
NUMBERS = ("-9999", "-9999.0", "1e30", "99999", "1.#QNAN")
FORMATS = {
    "iso": "%Y-%m-%d %H:%M:%S",
    "iso-t": "%Y-%m-%dT%H:%M:%S",
    "utc": "%Y-%m-%dT%H:%M:%SZ",
    "offset": "%Y-%m-%dT%H:%M:%S+02:00",
    "german": "%d.%m.%Y %H:%M:%S",
    "british": "%d/%m/%Y %H:%M:%S",
    "american": "%m/%d/%Y %I:%M:%S %p",
    "historian": "%d-%b-%y %H:%M:%S",
    "two columns": "%Y-%m-%d|%H:%M:%S",
    "seconds": None,
}


@dataclass(frozen=True)
class Ugly:
    """One export.

    Attributes:
        content: of the file.
        dt: seconds between samples.
        u, y: what the plant really did, shape (N, 2) and (N, 1).
        good: samples of which the file has a complete row of good values, shape (N,).
        features: what makes it ugly, for messages.
    """

    content: bytes
    dt: float
    u: np.ndarray
    y: np.ndarray
    good: np.ndarray
    features: dict


def ugly_export(seed):
    """An export with a random choice of everything that plants' exports have."""
    rng = np.random.default_rng(seed)

    def often(probability):
        return bool(rng.random() < probability)

    samples = int(rng.integers(30, 90))
    dt = float(rng.choice([1, 5, 10, 60, 900, 3600]))
    digits = int(rng.integers(0, 5))
    size = 10.0 ** rng.uniform(-1, 4)
    u = np.round(
        size * (3 + np.repeat(rng.integers(0, 2, (samples // 5 + 1, 2)), 5, axis=0)[:samples]), digits
    )
    y = np.round(size * (2 + np.cumsum(rng.standard_normal((samples, 1)), axis=0) / 20), digits)
    separator = str(rng.choice([",", ";", "\t"]))
    decimal = "," if separator != "," and often(0.5) else "."
    style = str(rng.choice(list(FORMATS)))
    features = {"separator": separator, "decimal": decimal, "style": style, "dt": dt, "digits": digits}
    start = datetime.datetime(2024, 1, 1) + datetime.timedelta(minutes=int(rng.integers(0, 500_000)))
    good = np.ones(samples, dtype=bool)
    quality = str(rng.choice(["none", "each", "one"], p=[0.6, 0.2, 0.2]))

    rows = []
    for k in range(samples):
        moment = start + datetime.timedelta(seconds=k * dt)
        form = FORMATS[style]
        stamp = [f"{k * dt:g}".replace(".", decimal)] if form is None else moment.strftime(form).split("|")
        cells = [f"{value:.{digits}f}".replace(".", decimal) for value in (*u[k], *y[k])]
        states = ["Good", "Good", "Good"]
        if often(0.02):
            mark = str(rng.choice([*WORDS, *NUMBERS])).replace(".", decimal if "#" not in cells else ".")
            cells[int(rng.integers(0, 3))] = mark
            good[k] = False
        if quality != "none" and often(0.02):
            states[int(rng.integers(0, 3))] = str(rng.choice(["Bad", "Uncertain", "Stale"]))
            good[k] = False
        if quality == "each":
            cells = [cell for pair in zip(cells, states, strict=True) for cell in pair]
        elif quality == "one":
            cells.append(next((state for state in states if state != "Good"), "Good"))
        rows.append((k, [*stamp, *cells]))
    if often(0.3):
        at = int(rng.integers(5, samples - 10))
        gone = set(range(at, at + int(rng.integers(1, 6))))
        rows = [row for row in rows if row[0] not in gone]
        good[list(gone)] = False
        features["gap"] = at
    if often(0.2):
        copy = int(rng.integers(0, len(rows)))
        rows.insert(copy, rows[copy])
        features["duplicate"] = copy
    if often(0.15):
        rows = rows[::-1]
        features["order"] = "backwards"
    elif often(0.15):
        i = int(rng.integers(0, len(rows) - 6))
        rows[i], rows[i + 5] = rows[i + 5], rows[i]
        features["order"] = "mixed"

    time = (
        ["Date", "Hour"]
        if style == "two columns"
        else [str(rng.choice(["time", "Timestamp", "Zeitstempel"]))]
    )
    units = often(0.3)
    names = [name + (" [%]" if units else "") for name in ("FIC-1.OP", "FIC-2.OP", "TI 3")]
    if quality == "each":
        names = [
            name for pair in zip(names, (f"{name}.Quality" for name in names), strict=True) for name in pair
        ]
    elif quality == "one":
        names.append("Status")
    lines = [[*time, *names]]
    if often(0.3):
        lines.append(["" for _ in time] + ["description of it" for _ in names])
    if often(0.3):
        lines.append(["" for _ in time] + ["m3/h" for _ in names])
    out = io.StringIO()
    if often(0.2):
        out.write(f"Export of plant 7{separator}\r\n\r\n")
    writer = csv.writer(out, delimiter=separator)
    writer.writerows([*lines, *(cells for _, cells in rows)])
    if often(0.2):
        out.write(f"{len(rows)} rows exported\r\n")
    encoding = str(rng.choice(["utf-8", "utf-8-sig", "utf-16", "cp1252"]))
    features |= {"quality": quality, "encoding": encoding}
    return Ugly(out.getvalue().encode(encoding), dt, u, y, good, features)
