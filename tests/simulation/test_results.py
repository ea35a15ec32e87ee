"""Results leave and come back as they were: labelled arrays, tables, files, figures."""

import copy
import dataclasses
import pickle

import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import heliograph as hg
from heliograph.disk import quote_for_file, unquote_file
from heliograph.simulation import ErrorStatistics, StatisticsByName, Uplink

matplotlib.use("Agg")
RUNS, STEPS = 40, 12
AWKWARD = st.text(st.characters(exclude_categories=[]), max_size=4)  # every character there is, lone surrogates too
NAMES = AWKWARD | st.sampled_from(["", "fused", "time", "state", "nan", "None", "0", "a/b", "a.b", "=1+1", "\\x41"])
NUMBERS = st.floats(width=64) | st.sampled_from([np.nan, -0.0, np.inf, 5e-324])


def drive(x, u):
    return jnp.stack([x[0] + 0.1 * x[1], 0.9 * x[1]])


PLANT = hg.Plant(drive, 0.1 * np.eye(2), [0, 1], np.eye(2), states=["position", "velocity"])
SENSOR = hg.Sensor(jnp.sin, 0.1 * np.eye(2))
LINK = hg.hop(hg.Discrete([0.8, 1.2], [0.5, 0.5]), 0.1 * np.eye(2))
FILTERS = {"aware": hg.cubature_filter(PLANT, SENSOR, LINK), "trusting": hg.mean_gain_filter(PLANT, SENSOR, LINK)}
NETWORK = hg.Network(PLANT, {"cart": hg.Node(SENSOR, LINK, FILTERS)})
UNITS = {"position": "m", "velocity": "m/s"}


@pytest.fixture(scope="module")
def runs() -> hg.Record:
    return hg.monte_carlo(NETWORK, STEPS, RUNS, key=0).with_units(UNITS)


@pytest.fixture(scope="module")
def result() -> StatisticsByName:
    return hg.monte_carlo(NETWORK, STEPS, RUNS, key=0, keep=hg.Statistics()).with_units(UNITS)


@st.composite
def records(draw) -> hg.Record:
    """Any record of a network with any names, shapes and numbers."""
    states = draw(st.lists(NAMES, min_size=1, max_size=2, unique=True))
    nodes = draw(st.lists(NAMES, min_size=1, max_size=3, unique=True))
    several, steps, n = draw(st.sampled_from([None, 1, 2])), draw(st.integers(1, 3)), len(states)
    lead = (steps,) if several is None else (several, steps)
    seed = np.random.default_rng(draw(st.integers(0, 2**32)))
    special = draw(st.lists(NUMBERS, min_size=1, max_size=5))

    def numbers(*shape: int) -> np.ndarray:
        values = seed.normal(size=(*lead, *shape))
        values.flat[: len(special)] = special[: values.size]
        return values

    estimates = {}
    for node in nodes:
        names = draw(st.lists(NAMES, min_size=1 if node == nodes[0] else 0, max_size=2, unique=True))
        claims = [draw(st.sampled_from(["exact", "upper", "nominal", "none"])) for _ in names]
        estimates[node] = {
            name: hg.model.Estimate(numbers(n), numbers(n, n), claim) for name, claim in zip(names, claims, strict=True)
        }
    uplinks = {
        name: Uplink(tuple(nodes[::-1]), numbers(len(nodes), n) > 0, np.ones((*lead, len(nodes), n), dtype=int))
        for name in draw(st.lists(NAMES, max_size=2, unique=True))
    }
    dates = np.datetime64("2026-10-25T00:59:59.123456789", "ns") + np.arange(steps) * np.timedelta64(7, "ns")
    return hg.Record(
        time=draw(st.sampled_from([np.zeros(steps), np.arange(steps) / 3, dates])),
        states=tuple(states),
        truth=numbers(n) if draw(st.booleans()) else None,
        measurements={node: numbers(draw(st.integers(1, 2))) for node in nodes},
        estimates=estimates,
        uplinks=uplinks,
        units={states[0]: draw(NAMES) or "m"} if draw(st.booleans()) else {},
    )


def identical(item: hg.Record, other: hg.Record) -> bool:
    """Equal, and every number of the same bits, the sign of a zero too."""

    def bits(record: hg.Record) -> list[bytes]:
        every = [e for node in sorted(record.estimates) for _, e in sorted(record.estimates[node].items())]
        arrays = [record.time, record.truth, *(e.mean for e in every), *(e.covariance for e in every)]
        numbers = [a for a in arrays if a is not None and a.dtype.kind == "f"]
        return [np.where(np.isnan(a), np.nan, a).tobytes() for a in numbers]

    return item == other and bits(item) == bits(other)


@settings(max_examples=25, derandomize=True)
@given(record=records())
def test_a_record_comes_back_from_arrays_tables_and_pickles(record):
    assert identical(hg.Record.from_xarray(record.to_xarray()), record)
    assert identical(hg.Record.from_pandas(record.to_pandas()).with_units(record.units), record)
    assert identical(pickle.loads(pickle.dumps(record)), record) and identical(copy.deepcopy(record), record)


@settings(max_examples=8, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(record=records(), ending=st.sampled_from([".nc", ".nc", ".zarr"]))
def test_a_record_comes_back_from_a_file(record, ending, tmp_path):
    path = tmp_path / f"record{ending}"
    record.save(path)
    assert identical(hg.Record.open(path), record)
    assert [p.name for p in tmp_path.iterdir() if p != path and p.suffix != (".nc", ".zarr")[ending == ".nc"]] == []


@settings(max_examples=200, derandomize=True)
@given(name=AWKWARD)
def test_names_in_files_can_be_read_and_undone(name):
    assert unquote_file(quote_for_file(name)) == name and quote_for_file(name).isprintable()


@pytest.mark.slow
@settings(max_examples=8, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    names=st.lists(NAMES, min_size=2, max_size=2, unique=True),
    numbers=st.lists(NUMBERS, min_size=1, max_size=6),
    failed=st.booleans(),
    uplink=st.booleans(),
)
def test_statistics_come_back(names, numbers, failed, uplink, tmp_path):
    values = np.resize(numbers, (50, 3, 3))

    def single(claim: str, sent: Uplink | None = None) -> ErrorStatistics:
        by_step = np.arange(3.0) if failed else None
        return ErrorStatistics(np.full(50, 2.0), values, values[::-1], values[..., 0], claim, sent, by_step, 2 * failed)

    sent = Uplink((names[0],), values[0][:, None, :2], values[0][:, None, :2]) if uplink else None
    by_name = {names[0]: {n: single("upper") for n in names}, "fused": {names[1]: single("none", sent)}}
    result = StatisticsByName(by_name, ("a", names[0] + "b"))
    with np.errstate(all="ignore"):
        assert StatisticsByName.from_xarray(result.to_xarray()) == result
        result.save(tmp_path / "found.nc")
    assert StatisticsByName.open(tmp_path / "found.nc") == result and pickle.loads(pickle.dumps(result)) == result


def test_labels_select_what_they_say(runs, result):
    data = runs.to_xarray()
    item = data["mean"].sel(node="cart", filter="aware", state="velocity")
    np.testing.assert_array_equal(item, runs.estimates["cart"]["aware"].mean[..., 1])
    assert data.attrs["claims"] == "cart/aware: nominal, cart/trusting: nominal"
    assert data.attrs["states"] == "position, velocity" and list(data["unit"].values) == ["m", "m/s"]
    part = hg.Record.from_xarray(data.isel(run=slice(3, 5)).sel(filter=["aware"]))
    np.testing.assert_array_equal(part.truth, runs.truth[3:5])
    assert list(part.estimates["cart"]) == ["aware"]
    frame = runs.to_pandas()
    np.testing.assert_array_equal(frame["cart", "aware", "mean", "velocity", ""], item.to_numpy().reshape(-1))
    np.testing.assert_array_equal(frame.loc[7]["", "", "truth"].to_numpy(), runs.truth[7])
    of = result.to_xarray()["rmse"].sel(node="cart", filter="trusting")
    squares = runs.errors("cart", "trusting") ** 2
    np.testing.assert_allclose(of, np.sqrt(squares.mean(axis=0)), rtol=1e-12)  # sums in another order


def test_every_state_has_an_rmse(runs, result):
    squares = (runs.errors("cart", "aware") ** 2).mean(axis=(0, 1))
    assert runs.rmse("cart", "aware") == dict(zip(runs.states, np.sqrt(squares), strict=True))
    local, error = result["cart"]["aware"].rmse_by_state()
    np.testing.assert_allclose(local, np.sqrt(squares), rtol=1e-12)  # sums in another order
    total, total_error = result["cart"]["aware"].rmse()
    assert np.isclose(total**2, (local**2).sum(), rtol=1e-12) and (error > 0).all() and total_error < error.sum()
    table = result.to_pandas().loc["cart", "aware"]
    assert table["rmse of velocity"] == local[1] and table["rmse error of velocity"] == error[1]
    assert table["claim"] == "nominal" and table["nees low"] < table["nees"] < table["nees high"]
    claimed = np.diagonal(runs.estimates["cart"]["aware"].covariance, axis1=-2, axis2=-1).mean(axis=(0, 1))
    assert np.isclose(table["claimed of position"] ** 2, claimed[0], rtol=1e-12)


def test_bad_places_and_files(runs, result, tmp_path):
    def refused(call, *words):
        with pytest.raises(ValueError) as raised:
            call()
        assert all(word in str(raised.value) for word in words) and "\n" not in str(raised.value), raised.value

    refused(lambda: runs.save(tmp_path / "runs.h5"), "ends in .nc or .zarr", "'.h5'")
    refused(lambda: runs.save(tmp_path / "no" / "runs.nc"), "an existing folder")
    (tmp_path / "mine.zarr").mkdir()
    (tmp_path / "mine.zarr" / "thesis.txt").touch()
    refused(lambda: runs.save(tmp_path / "mine.zarr"), "thesis.txt, which would be lost")
    refused(lambda: hg.Record.open(tmp_path / "no.nc"), "a file of results", "nothing of that name")
    (tmp_path / "no.nc").write_text("no")
    refused(lambda: hg.Record.open(tmp_path / "no.nc"), "can be read")
    result.save(tmp_path / "found.nc")
    refused(lambda: hg.Record.open(tmp_path / "found.nc"), "title is 'heliograph record'", "heliograph statistics")
    refused(lambda: hg.Record.from_xarray(runs.to_xarray().sel(node="cart")), "the dimension 'node'")
    refused(lambda: hg.Record.from_pandas(result.to_pandas()), "Record.to_pandas")
    refused(lambda: runs.with_units({"speed": "m/s"}), "names of states ['position', 'velocity']", "'speed'")
    refused(lambda: runs.errors("cart", "awar"), "one of cart/aware, cart/trusting", "cart/awar")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["found.nc", "mine.zarr", "no.nc"]


def test_states_are_found_by_their_names_in_datasets_and_tables(runs):
    """Places were taken for names: a selection of one axis of states left covariances of others, without a word."""
    expected = runs.estimates["cart"]["aware"]

    def check(record, states):
        places = [runs.states.index(state) for state in states]
        assert record.states == tuple(states)
        found = record.estimates["cart"]["aware"]
        np.testing.assert_array_equal(found.mean, np.asarray(expected.mean)[..., places])
        covariance = np.asarray(expected.covariance)[..., places, :][..., places]
        np.testing.assert_array_equal(found.covariance, covariance)

    dataset, frame = runs.to_xarray(), runs.to_pandas()
    check(hg.Record.from_xarray(dataset.isel(state=[1, 0])), ["velocity", "position"])
    check(hg.Record.from_xarray(dataset.isel(other=[1, 0])), ["position", "velocity"])
    check(hg.Record.from_xarray(dataset.isel(state=[1])), ["velocity"])
    with pytest.raises(ValueError, match="dimension 'other': expected the states, position, velocity, got velocity"):
        hg.Record.from_xarray(dataset.isel(other=[1]))
    names = list(frame.columns)
    swapped = {("cart", "aware", "mean"), ("cart", "aware", "covariance (nominal)")}
    order = sorted(range(len(names)), key=lambda i: (names[i][:3] in swapped, -i if names[i][:3] in swapped else i))
    assert order != list(range(len(names)))
    check(hg.Record.from_pandas(frame.iloc[:, order]), ["position", "velocity"])
    without = [i for i, name in enumerate(names) if name[2:] != ("covariance (nominal)", "velocity", "velocity")]
    with pytest.raises(
        ValueError, match=r"table, covariance \(nominal\) of cart/\w+: expected a column for each of pos"
    ):
        hg.Record.from_pandas(frame.iloc[:, without])


def test_statistics_of_a_part_of_the_states_are_refused(result):
    """The NEES of all states was divided by the number of those that were left: twice what it is."""
    dataset = result.to_xarray()
    reordered = type(result).from_xarray(dataset.isel(state=[1, 0]))
    np.testing.assert_allclose(reordered.to_pandas()["nees"], result.to_pandas()["nees"], rtol=1e-12)  # another order
    for part in (dataset.isel(state=[0]), dataset.isel(state=[0], other=[0])):
        with pytest.raises(
            ValueError, match="dimension 'state': expected all states, position, velocity, since the NEES"
        ):
            type(result).from_xarray(part)


def test_rows_of_runs_are_whole_and_in_order(runs):
    """Rows were taken by their places: of a shuffled table the runs were mixed, and a missing row was NumPy's error."""
    frame = runs.to_pandas()
    shuffled = frame.sample(frac=1, random_state=0)
    for table in (shuffled, frame.iloc[1:]):
        with pytest.raises(ValueError, match="table, rows: expected the same times of each run, one run after another"):
            hg.Record.from_pandas(table)
    np.testing.assert_array_equal(hg.Record.from_pandas(shuffled.sort_index()).truth, runs.truth)


def test_plots_draw_on_what_they_are_given(runs, result, tmp_path):
    figure = plt.Figure()
    both = figure.subplots(2, 1)
    assert runs.plot(axes=both, run=3) == list(both)
    lines = {line.get_label(): line.get_ydata() for line in both[1].lines}
    np.testing.assert_array_equal(lines["aware"], runs.estimates["cart"]["aware"].mean[3, :, 1])
    np.testing.assert_array_equal(lines["truth"], runs.truth[3, :, 1])
    band = both[1].collections[0].get_paths()[0].vertices[:, 1]
    deviation = np.sqrt(runs.estimates["cart"]["aware"].covariance[3, :, 1, 1])
    assert np.isclose(band.max(), (lines["aware"] + 2 * deviation).max()) and both[1].get_ylabel() == "velocity (m/s)"
    (item,) = result.plot(states="position", filters=["aware"], axes=figure.add_subplot())
    np.testing.assert_allclose(item.lines[0].get_ydata(), result["cart"]["aware"].rmse_by_state()[0][0], rtol=0.5)
    recording = hg.run(NETWORK, {"cart": runs.measurements["cart"][0]})
    new = recording.plot(states=["velocity"])
    turning = hg.Record(
        np.arange(5.0), ("yaw",), None, {},
        {"n": {"f": hg.model.Estimate(
            np.array([[3.0], [3.1], [-3.1], [-3.0], [-2.9]]), np.full((5, 1, 1), 0.01), "exact")}},
    )  # fmt: skip
    (line,) = turning.plot()[0].lines  # no line where the angle goes around
    np.testing.assert_array_equal(line.get_ydata(), [3, 3.1, np.nan, -3.1, -3, -2.9])
    # With the truth estimates are within half a turn of it, so beyond pi where it is near that.
    yaw = np.array([[3.0], [3.2], [-3.0], [-2.9], [-2.8]])
    beside = dataclasses.replace(
        turning, truth=np.array([[3.0], [3.1], [-3.1], [np.nan], [-2.9]]),
        estimates={"n": {"f": hg.model.Estimate(yaw, np.full((5, 1, 1), 0.01), "exact")}},
    )  # fmt: skip
    line, true_line = beside.plot()[0].lines
    np.testing.assert_array_equal(line.get_ydata(), [3, 3.2, np.nan, -3, -2.9, -2.8])
    np.testing.assert_array_equal(true_line.get_ydata(), [3, 3.1, np.nan, -3.1, np.nan, -2.9])
    new[0].figure.savefig(tmp_path / "plot.png")
    plt.close(new[0].figure)
    for call in (lambda: runs.plot(node="no"), lambda: runs.plot(filters=["no"]), lambda: runs.plot(states=["no"]),
                 lambda: runs.plot(run=RUNS), lambda: runs.plot(axes=both[:1])):  # fmt: skip
        with pytest.raises(ValueError, match=r"expected .*, got"):
            call()


def test_a_file_opens_without_us(runs, tmp_path):
    runs.save(tmp_path / "runs.nc")
    with xr.open_dataset(tmp_path / "runs.nc") as data:
        assert list(data["state"].values) == ["position", "velocity"] and data.attrs["claims"].startswith("cart/aware")
        np.testing.assert_array_equal(data["truth"], runs.truth)
