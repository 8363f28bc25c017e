# SPDX-License-Identifier: Apache-2.0
"""What a number means beyond its value is refused at every public name, never dropped.

A mask, an imaginary part, a duration, a date, a unit, text and truth values: NumPy
turns each of them into plain doubles without a word. Times may be given as durations;
numbers of a document may be text, as in a YAML file.
"""

import datetime
import warnings
from functools import partial
from inspect import signature

import numpy as np
import pytest
from test_wrong_arguments import REST, SCENE, STUDY, TASK, calls  # noqa: F401

import sst_ros
from sst_ros import (
    Batch,
    InputError,
    Simulation,
    SstError,
    TorqueTable,
    Trajectory,
    simulate,
)
from sst_ros.state import NotNumbers, real_numbers

TIMES = {"t", "t_eval", "breaks", "times", "breakpoints"}
"""Parameters that take durations."""


class Quantity(np.ndarray):
    """Numbers with a unit, as those of astropy and unyt."""

    unit = "deg"

    def __iter__(self):
        return (np.asarray(x).view(Quantity) for x in np.asarray(self))


def masked(x):
    return np.ma.array(x, mask=np.arange(x.size).reshape(x.shape) == 0)


def in_milliseconds(x):
    return np.rint(1e3 * x).astype("m8[ms]")


KINDS = {
    "masked": masked,
    "masked rows": lambda x: list(masked(x)) if x.ndim else masked(x),
    "complex": lambda x: x + 1j,
    "complex single": lambda x: np.asarray(x + 1j, np.complex64),
    "complex objects": lambda x: (x + 1j).astype(object),
    "durations": in_milliseconds,
    "nanoseconds": lambda x: in_milliseconds(x).astype("m8[ns]"),
    "timedelta": lambda x: in_milliseconds(x).astype(object),
    "dates": lambda x: np.datetime64("2026-01-01", "ms") + in_milliseconds(x),
    "datetime": lambda x: (
        np.datetime64("2026-01-01", "ms") + in_milliseconds(x)
    ).astype(object),
    "degrees": lambda x: x.view(Quantity),
}
DURATIONS = ("durations", "nanoseconds", "timedelta")


def cases(public):
    """Yield a call, what it is given, and the name of an argument that is numbers."""
    run = simulate(**TASK)
    extra = {
        "initial": (SCENE.initial.gamma, REST),
        "t_eval": [0.0, 0.005],
        "breaks": [0.005],
        "max_step": 1e-3,
        "noise": [1e-3] * 3,
        "torque": [0.1, 0.2, 0.3],
        "period": 1e-3,
    }
    for function, right in public:
        filled = {
            name: extra.get(name) if x is None else x for name, x in right.items()
        }
        for name, value in filled.items():
            try:
                array = np.array(real_numbers(value))
            except (NotNumbers, InputError):
                continue
            if array.size and not isinstance(value, (bool, np.bool_)):
                yield function, right, name, array
    motion = {
        name: getattr(run, name) for name in ("t", "gamma", "torque", "gamma_dot")
    }
    for name, array in motion.items():
        yield identify_arrays, motion, name, array
    for key, value in {
        "star.mass": 1.0,
        "base.v": np.eye(3),
        "initial.gamma": REST,
    }.items():
        yield partial(change_scene, key), {}, "value", np.array(value)
    for form in FORMS:
        yield partial(vary, FORMS[form]), {}, "zz", np.array([0.26, 0.27])


def describe(function):
    if isinstance(function, partial):
        return f"{describe(function.func)}{function.args}"
    line = getattr(getattr(function, "__code__", None), "co_firstlineno", "")
    return f"{function.__qualname__}:{line}"


def identify_arrays(**data):
    return sst_ros.identify(data, SCENE)


def change_scene(key, value):
    return SCENE.with_values({key: value})


def vary(form, zz):
    return form(zz)


def sweep(values):
    return sst_ros.sweep(**STUDY | {"vary": {"star.inertia.zz": values}})


FORMS = {
    "parameters": lambda zz: Batch(SCENE, parameters={"star.inertia.zz": zz}),
    "grid": sweep,
    "list": lambda zz: sweep(list(zz)),
    "uniform": lambda zz: sweep(("uniform", *zz)),
    "mapping": lambda zz: sweep({"grid": zz}),
    "table": lambda zz: sst_ros.sweep(
        **STUDY | {"vary": {}, "table": {"star.inertia.zz": zz}}
    ),
}
"""Ways in which numbers that vary are given."""


@pytest.mark.parametrize("kind", KINDS)
def test_what_numbers_mean_is_not_dropped(calls, kind, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.chdir(tmp_path)
    taken = []
    for function, right, name, array in cases(calls):
        if (kind in DURATIONS and name in TIMES) or (
            kind == "degrees" and not array.ndim
        ):
            continue
        given, where = KINDS[kind](array), f"{describe(function)}({name})"
        if isinstance(given, np.ndarray) and given.ndim == 0:
            given = given[()]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                function(**right | {name: given})
            except SstError as error:
                assert str(error)
            except Exception as error:
                taken.append(f"{where}: {type(error).__name__}: {error}")
            else:
                taken.append(where)
    assert taken == [], "\n".join(taken)


def as_durations(times):
    """Times in all forms of durations."""
    pandas = pytest.importorskip("pandas")
    whole = np.rint(np.asarray(times) * 1e9).astype("m8[ns]")
    yield whole
    yield whole.astype("m8[us]")
    yield [datetime.timedelta(microseconds=round(1e6 * t)) for t in times]
    yield pandas.to_timedelta(times, unit="s")
    yield pandas.Series(pandas.to_timedelta(times, unit="s"))


def test_durations_are_seconds_where_times_are_asked_for():
    times = np.arange(40) / 100.0
    run = simulate("swing", duration=0.39, t_eval=times)
    data = {"t": times, "gamma": run.gamma, "torque": run.torque}
    plain = sst_ros.identify(data, "swing", "star")
    held = run.torque
    for given in as_durations(times):
        assert np.array_equal(simulate("swing", duration=0.39, t_eval=given).t, times)
        assert np.array_equal(run.at(given).t, times)
        assert np.array_equal(TorqueTable(given, held).times, times)
        arrays = run.quaternion, run.body_rate, run.torque
        assert np.array_equal(Trajectory(run.scene, given, *arrays).t, times)
        found = sst_ros.identify(data | {"t": given}, "swing", "star")
        assert np.array_equal(found.values, plain.values)


def test_dates_are_refused_with_what_to_give():
    pandas = pytest.importorskip("pandas")
    run = simulate("swing", duration=0.39, samples=39)
    dates = pandas.date_range("2026-01-01", periods=40, freq="10ms")
    data = {"t": dates, "gamma": run.gamma, "torque": run.torque}
    with pytest.raises(InputError, match="no dates: give seconds since the start"):
        sst_ros.identify(data, "swing")


def test_functions_give_plain_torques():
    for torque in (
        masked(np.ones(3)),
        np.ones(3) + 1j,
        in_milliseconds(np.ones(3)),
        ["1"] * 3,
    ):
        with pytest.raises(SstError), warnings.catch_warnings():
            warnings.simplefilter("error")
            simulate("example2", lambda t, torque=torque: torque, 0.01)


def test_a_table_with_a_complex_column_is_refused():
    pandas = pytest.importorskip("pandas")
    table = pandas.DataFrame({"star.inertia.zz": [0.26 + 1j, 0.27]})
    with pytest.raises(InputError, match="not complex"):
        sst_ros.sweep(SCENE, table, duration=0.01, progress=False)


@pytest.mark.parametrize("convert", [np.char.mod("%g", 1.0).dtype.type, np.bool_])
def test_arrays_of_text_and_of_truth_values_are_refused(convert):
    def changed(*shape):
        return np.ones(shape).astype(convert)

    run = simulate(**TASK)
    for call in (
        lambda: TorqueTable([0.0], changed(1, 3)),
        lambda: TorqueTable(changed(1), [REST]),
        lambda: sst_ros.PolynomialTorque(changed(1, 1, 3), [0.0, 1.0]),
        lambda: Trajectory(
            SCENE, run.t, run.quaternion, run.body_rate, changed(len(run), 3)
        ),
        lambda: sst_ros.Geometry.build(np.eye(3), changed(3)),
        lambda: simulate(**TASK | {"t_eval": changed(1)}),
        lambda: Batch(SCENE, parameters={"star.mass": changed(2)}),
        lambda: sst_ros.sweep(
            SCENE, {}, table={"star.mass": changed(2)}, duration=0.01
        ),
    ):
        with pytest.raises(InputError):
            call()


def test_own_arrays_with_units_are_taken():
    pytest.importorskip("xarray")
    run = simulate(**TASK)
    data = run.to_xarray()
    again = Trajectory(
        run.scene, data.time, data.quaternion, data.body_rate, data.torque
    )
    assert np.array_equal(again.gamma, run.gamma)
    with pytest.raises(InputError, match="in deg"):
        run.at(data.time.assign_attrs(units="deg"))


def test_every_parameter_that_takes_arrays_is_declared():
    """A parameter whose annotation says nothing of arrays is not checked by its
    annotation.
    """
    for name in sst_ros.__all__:
        value = getattr(sst_ros, name)
        if callable(value) and not isinstance(value, type):
            assert all(
                p.annotation is not p.empty
                for p in signature(value).parameters.values()
            )


def test_a_duration_is_no_number_of_nanoseconds():
    with pytest.raises(InputError, match="dt_ns"):
        Simulation(SCENE).step(REST, np.timedelta64(1, "ms"))
