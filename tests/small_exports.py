"""A small record as historians and loggers would write it, and what is read of it."""

import datetime

import numpy as np

from mampc import read_export

U = np.array([5, 5, 5, 8, 8, 8, 8, 5, 5, 8, 8, 5.0])
Y = np.round(20 + np.cumsum(U - 6.5) / 8, 3)


def stamps(samples=12, dt=60.0, start="2024-04-13 09:58:00", form="%Y-%m-%d %H:%M:%S"):
    first = datetime.datetime.fromisoformat(start)
    return [(first + datetime.timedelta(seconds=k * dt)).strftime(form) for k in range(samples)]


def rows(times=None, u=U, y=Y):
    return [
        [str(time), str(a), str(b)]
        for time, a, b in zip(stamps() if times is None else times, u, y, strict=True)
    ]


def text(lines, separator=",", header=("time", "u", "y")):
    return "\n".join(separator.join(line) for line in [header, *lines]) + "\n"


def write(folder, content, encoding="utf-8"):
    path = folder / "export.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode(encoding))
    return path


def read(folder, content, encoding="utf-8", inputs="u", outputs="y", **options):
    return read_export(write(folder, content, encoding), inputs=inputs, outputs=outputs, **options)


def told(export, *words):
    """Whether one note has all the words."""
    return any(all(word in note for word in words) for note in export.notes)


def assert_whole(export, dt=60.0):
    [record] = export.records
    assert record.dt == dt
    assert np.array_equal(record.u[:, 0], U)
    assert np.array_equal(record.y[:, 0], Y)
