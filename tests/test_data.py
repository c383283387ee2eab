"""Input-output records: their checks, their files, and how a plant is excited."""

import numpy as np
import pytest

from builders import random_model
from mampc import IOData, MampcError, Names, excite, prbs
from mampc.plants import QuadrupleTank

TANK = QuadrupleTank()


def record(samples=12, dt=0.5):
    rng = np.random.default_rng(0)
    names = Names(("fuel", "air"), ("voltage",))
    return IOData(rng.standard_normal((samples, 2)), rng.standard_normal((samples, 1)), dt, names)


def csv_file(folder, text):
    path = folder / "record.csv"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"u": np.zeros(4)}, "as many input as output samples, received 4 and 3"),
        ({"u": [], "y": []}, "received 0 and 0"),
        ({"u": np.zeros((3, 0))}, "at least one input and output, received 0 and 1"),
        ({"y": np.zeros((3, 2, 2))}, r"y: expected a matrix .* received shape \(3, 2, 2\)"),
        ({"y": 5.0}, r"y: expected a matrix .* received shape \(\)"),
        ({"u": [[1, 2], [3], [4]]}, "u: expected real numbers, received"),
        ({"u": ["a", "b", "c"]}, "u: expected real numbers, received"),
        ({"y": [1.0, np.nan, 2.0]}, r"y: expected finite numbers, received nan at \[1, 0\]"),
        ({"dt": 0.0}, "dt: expected a finite number above 0, received 0"),
        ({"dt": None}, "dt: expected a finite number above 0, received None"),
        ({"names": Names(("u",), ("y", "z"))}, "names.outputs: expected 1 names, received 2"),
    ],
)
def test_what_is_no_record_is_refused(changes, message):
    with pytest.raises(MampcError, match=message):
        IOData(**({"u": np.zeros(3), "y": np.zeros(3), "dt": 1.0} | changes))


def test_a_single_signal_may_be_a_vector():
    data = IOData([1, 2, 3], [4, 5, 6], 1)
    assert data.u.shape == data.y.shape == (3, 1)
    assert data.u.dtype == data.y.dtype == np.float64
    assert data.names == Names(("u1",), ("y1",))
    assert len(data) == 3


def test_slices_keep_samples_names_and_step():
    data = record()
    part = data[2:5]
    assert np.array_equal(part.u, data.u[2:5])
    assert np.array_equal(part.y, data.y[2:5])
    assert (part.dt, part.names) == (data.dt, data.names)


@pytest.mark.parametrize("rows", [3, "first", (1, 2), slice(5, 5)])
def test_only_slices_with_samples_are_records(rows):
    with pytest.raises(MampcError, match=r"IOData: expected .* received"):
        record()[rows]


@pytest.mark.parametrize(("share", "first"), [(2 / 3, 8), (0.5, 6), (0.1, 1), (0.9, 11)])
def test_splitting_keeps_every_sample_once_and_in_order(share, first):
    data = record()
    before, after = data.split(share)
    assert (len(before), len(after)) == (first, 12 - first)
    assert np.array_equal(np.concatenate([before.u, after.u]), data.u)
    assert np.array_equal(np.concatenate([before.y, after.y]), data.y)


@pytest.mark.parametrize("share", [0.0, 1.0, 0.01, 1.5, -0.5, np.nan])
def test_a_split_leaves_samples_on_both_sides(share):
    with pytest.raises(MampcError, match="share"):
        record().split(share)


def test_a_record_survives_its_file_to_the_last_bit(tmp_path):
    data = record(50, dt=0.1)
    data.to_csv(tmp_path / "record.csv")
    loaded = IOData.from_csv(tmp_path / "record.csv", inputs=data.names.inputs, outputs=data.names.outputs)
    assert np.array_equal(loaded.u, data.u)
    assert np.array_equal(loaded.y, data.y)
    assert loaded.names == data.names
    np.testing.assert_allclose(loaded.dt, data.dt, rtol=1e-12)
    assert [path.name for path in tmp_path.iterdir()] == ["record.csv"]


def test_columns_are_found_by_name_in_any_order(tmp_path):
    path = csv_file(tmp_path, "y,spare,b,time,a\n1,x,2,0,3\n4,,5,0.25,6\n")
    data = IOData.from_csv(path, inputs=["a", "b"], outputs=["y"])
    assert np.array_equal(data.u, [[3, 2], [6, 5]])
    assert np.array_equal(data.y, [[1], [4]])
    assert data.dt == 0.25


def test_spaces_blank_lines_and_a_byte_order_mark_do_not_matter(tmp_path):
    path = csv_file(tmp_path, "\ufeffu , y\r\n 1 ,2\r\n\r\n3, 4 \r\n\r\n")
    data = IOData.from_csv(path, inputs=["u"], outputs=["y"], dt=1.0)
    assert np.array_equal(data.u, [[1], [3]])
    assert np.array_equal(data.y, [[2], [4]])


def test_a_given_step_needs_no_time_column_and_contradicts_none(tmp_path):
    path = csv_file(tmp_path, "u,y\n1,2\n3,4\n5,6\n")
    assert IOData.from_csv(path, inputs=["u"], outputs=["y"], dt=2.0).dt == 2.0
    path = csv_file(tmp_path, "time,u,y\n0,1,2\n5,3,4\n10,5,6\n")
    with pytest.raises(MampcError, match="dt: expected 5 s, the step of column 'time', received 2 s"):
        IOData.from_csv(path, inputs=["u"], outputs=["y"], dt=2.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a header and at least one row of numbers, received 0 rows"),
        ("\n\n", "received 0 rows"),
        ("time,u,y\n", "received 1 row"),
        ("time,u,y\n0,1,2\n1,2\n", "expected 3 fields in row 3, received 2"),
        ("time,u,y\n0,1,2\n\n1,2,3,4\n", "expected 3 fields in row 4, received 4"),
        ("time,u,z\n0,1,2\n", r"expected one column 'y', received columns \['time', 'u', 'z'\]"),
        ("time,u,y,u\n0,1,2,3\n", "expected one column 'u', received columns"),
        ("u,y\n1,2\n3,4\n", "expected a column of times; .* pass the sample time"),
        (
            "time,u,y\n0,1,2\n1,two,3\n",
            "expected consecutive rows with a number in every column, received numbers in 1 of u, 2 of y in 2 rows",
        ),
        ("time,u,y\n0,1,2\n1,2 m,3\n", "expected a number in row 3, column 'u', received '2 m'"),
        (
            "time,u,y\n0,1,2\n\n\n1,2,\n",
            "expected consecutive rows with a number in every column, received numbers in 2 of u, 1 of y in 2 rows",
        ),
        ("time,u,y\n0,1,2\n1,2,3\n3,4,5\n", "expected an evenly increasing time column"),
        ("time,u,y\n0,1,2\n0,2,3\n", "expected a time for each sample, .* first in row 3"),
        ("time,u,y\n0,1,2\n", "expected an evenly increasing time column"),
        ("noon,u,y\n0,1,2\n", "expected a column of times"),
        ("time,u,y\n0,1,5,2,5\n1,2,5,3,5\n", "commas may both separate fields and mark decimals"),
    ],
)
def test_a_file_that_is_no_record_is_refused_with_the_place(tmp_path, text, message):
    with pytest.raises(MampcError, match=rf"(?s)record\.csv: .*{message}"):
        IOData.from_csv(csv_file(tmp_path, text), inputs=["u"], outputs=["y"])


def test_missing_files_directories_and_other_formats_are_refused(tmp_path):
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\r\n\x1a\n\xff\xfe")
    for name in ("missing.csv", "picture.png", ""):
        with pytest.raises(MampcError, match="expected a readable CSV, Excel, Parquet or JSON file"):
            IOData.from_csv(tmp_path / name, inputs=["u"], outputs=["y"])


def test_a_record_needs_inputs_and_outputs(tmp_path):
    path = csv_file(tmp_path, "time,u,y\n0,1,2\n1,2,3\n")
    for inputs, outputs in [([], ["y"]), (["u"], [])]:
        with pytest.raises(MampcError, match="expected at least one input and output"):
            IOData.from_csv(path, inputs=inputs, outputs=outputs)


def test_the_same_seed_gives_the_same_record_and_another_seed_other_noise():
    u = prbs(order=4, amplitude=10.0, mean=50.0, inputs=2)
    first, again, other = (excite(TANK, u, dt=10.0, noise=0.1, seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(first.y, again.y)
    assert np.array_equal(first.u, other.u)
    assert not np.array_equal(first.y, other.y)


def test_noise_has_the_asked_deviation_per_output_and_is_white():
    model = random_model(0)
    u = np.tile(model.u_op, (20_000, 1))
    error = excite(model, u, noise=[0.1, 3.0], seed=5).y - model.y_op
    np.testing.assert_allclose(error.std(axis=0), [0.1, 3.0], rtol=0.02)
    np.testing.assert_allclose(error.mean(axis=0), 0, atol=0.1)
    correlations = np.corrcoef(np.vstack([error[1:].T, error[:-1].T]))
    np.testing.assert_allclose(correlations, np.eye(4), atol=0.03)


def test_a_plant_is_recorded_from_its_steady_state():
    u = prbs(order=5, amplitude=20.0, mean=50.0, inputs=2)
    data = excite(TANK, u, dt=10.0)
    np.testing.assert_allclose(data.y[0], TANK.output(TANK.steady_state()))
    assert np.array_equal(data.u, u)
    assert (data.dt, data.names.inputs, data.names.outputs) == (10.0, ("u1", "u2"), ("y1", "y2"))


def test_outputs_answer_inputs_one_sample_later():
    u = np.full((4, 2), 50.0)
    u[1:] = 80.0
    y = excite(TANK, u, dt=10.0).y
    np.testing.assert_allclose(y[1], y[0], rtol=1e-7)
    assert (y[2] > y[1] + 0.1).all()


def test_a_record_may_start_elsewhere():
    u = np.full((300, 2), 50.0)
    data = excite(TANK, u, dt=20.0, x0=[0.0, 0.0, 0.0, 0.0])
    assert np.array_equal(data.y[0], [0.0, 0.0])
    np.testing.assert_allclose(data.y[-1], TANK.output(TANK.steady_state()), rtol=1e-3)


def test_a_model_is_excited_as_it_responds():
    model = random_model(2, feedthrough=True)
    u, x0 = np.random.default_rng(2).standard_normal((30, 2)), [1.0, 2.0, 3.0]
    assert np.array_equal(excite(model, u, x0=x0).y, model.response(u, x0))
    assert excite(model, u).dt == excite(model, u, dt=1.0).dt == 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"dt": None}, "dt: expected"),
        ({"dt": -1.0}, "dt: expected"),
        ({"u": np.full((3, 3), 50.0)}, r"u: expected a matrix of shape \(any, 2\), received shape \(3, 3\)"),
        ({"u": np.full((3, 2), np.nan)}, "u: expected finite numbers"),
        ({"u": [["a", "b"]]}, "u: expected real numbers"),
        ({"noise": [0.1, 0.1, 0.1]}, "noise: expected a scalar or 2 values"),
        ({"noise": -0.1}, "noise: expected numbers of at least 0"),
        ({"seed": -1}, "seed: expected"),
        ({"x0": [1.0, 2.0]}, "x0: expected a scalar or 4 values"),
        ({"x0": [1.0, 2.0, 3.0, np.nan]}, "x0: expected finite numbers"),
    ],
)
def test_a_wrong_excitation_is_refused_by_name(arguments, message):
    with pytest.raises(MampcError, match=message):
        excite(TANK, **({"u": np.full((3, 2), 50.0), "dt": 1.0} | arguments))


def test_a_model_is_not_excited_at_another_step():
    with pytest.raises(MampcError, match="expected a discrete model and its dt"):
        excite(random_model(0), np.zeros((3, 2)), dt=2.0)
