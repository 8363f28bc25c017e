# SPDX-License-Identifier: Apache-2.0
"""Samples of a study: row i depends on the seed and on i alone, and has the
distribution asked.
"""

from array import array

import numpy as np
import pytest
from scipy import stats

from sst_ros import InputError, load_scene
from sst_ros.sweeps.sweep_study import SweepStudy
from sst_ros.sweeps.variations import SAMPLINGS, philox

SCENE = load_scene("example2_heavy")
KEY = "star.inertia.zz"


def rows(vary, n=1000, first=0, count=None, **options):
    study = SweepStudy(SCENE, vary, n=n, **options)
    return study.draw(first, count or n)


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_a_row_does_not_depend_on_what_is_drawn_with_it(sampling):
    vary = {KEY: ("normal", 0.26, 0.01), "torque.amplitude": ("uniform", 1.0, 2.0)}
    whole = rows(vary, sampling=sampling, seed=5)
    for first, count in ((0, 1), (17, 300), (999, 1)):
        part = rows(vary, sampling=sampling, seed=5, first=first, count=count)
        for key, values in part.items():
            assert np.array_equal(values, whole[key][first : first + count])
    other = rows(vary, sampling=sampling, seed=6)
    assert not np.any(other[KEY] == whole[KEY])


def test_the_generator_is_the_published_philox():
    """The counter is the row: four numbers a value of the counter."""
    raw = np.random.Generator(np.random.Philox(key=3)).random(40)
    found = philox(3, 0, 5, 8).ravel()
    np.testing.assert_allclose(found, raw, atol=2.0**-53)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (("uniform", 0.2, 0.3), stats.uniform(0.2, 0.1)),
        (("normal", 0.26, 0.01), stats.norm(0.26, 0.01)),
        (("normal", 0.26, 0.01, 0.255, 0.28), stats.truncnorm(-0.5, 2.0, 0.26, 0.01)),
        (("uniform", *np.array([0.2, 0.3])), stats.uniform(0.2, 0.1)),
        (("uniform", 0.9, 1.1, "relative"), stats.uniform(0.9 * 0.26, 0.2 * 0.26)),
        ({"normal": [1.0, 0.1], "relative": True}, stats.norm(0.26, 0.026)),
    ],
)
def test_samples_have_their_distribution(given, expected):
    found = rows({KEY: given}, n=20_000)[KEY][:, 0]
    assert stats.kstest(found, expected.cdf).pvalue > 1e-3


def test_sobol_points_fill_each_range_evenly():
    """Of 1024 points one lies in each 1024th, which no random sample does."""
    found = rows({KEY: ("uniform", 0.0001, 1.0001)}, n=1024, sampling="sobol")[KEY]
    cells = np.floor((found[:, 0] - 0.0001) * 1024).astype(int)
    assert len(set(cells.clip(0, 1023))) >= 1023


def test_a_grid_is_the_product_of_its_axes_the_last_is_fastest():
    vary = {KEY: [0.2, 0.3], "initial.gamma": [[0.7] * 3, [0.8] * 3, [0.9] * 3]}
    study = SweepStudy(SCENE, vary)
    assert study.rows == 6
    found = study.draw(0, 6)
    assert found[KEY][:, 0].tolist() == [0.2] * 3 + [0.3] * 3
    assert found["initial.gamma"][:, 1].tolist() == [0.7, 0.8, 0.9] * 2
    # it has tolist, as in pandas
    series = SweepStudy(SCENE, vary | {KEY: array("d", [0.2, 0.3])})
    assert series.digest == study.digest
    even = {
        KEY: ("linspace", 0.2, 0.3, 2),
        "initial.gamma": ("linspace", 0.7, [0.9, 0.7, 1.1], 3),
    }
    found = SweepStudy(SCENE, even).draw(0, 6)
    assert found[KEY][:, 0].tolist() == [0.2] * 3 + [0.3] * 3
    np.testing.assert_allclose(
        found["initial.gamma"][:3], [[0.7] * 3, [0.8, 0.7, 0.9], [0.9, 0.7, 1.1]]
    )


def test_one_factor_scales_a_whole_tensor():
    study = SweepStudy(
        SCENE, {"actuated_links.inertia": ("uniform", 0.5, 2.0, "relative")}, n=9
    )
    (one,) = study.variations
    factor = study.draw(0, 9)[one.key]
    assert one.columns == ("actuated_links.inertia",)
    found = one.parameters(factor)
    assert len(found) == 3 * 4
    inertia = SCENE.actuated_links[1].inertia
    np.testing.assert_array_equal(
        found["actuated_links[1].inertia.xz"], inertia.xz * factor[:, 0]
    )


REFUSED = [
    (
        {"vary": {"star.weight": [1.0]}},
        "vary.star.weight = .*: unknown key; allowed are",
    ),
    (
        {"vary": {KEY: ("uniform", 0.3, 0.2)}},
        "the lower end must be less than the upper one",
    ),
    (
        {"vary": {KEY: ("gauss", 0.3, 0.2)}},
        "must be a list of values, or one of uniform, normal",
    ),
    ({"vary": {KEY: ("normal", 0.3, -0.2)}}, "the standard deviation must be > 0"),
    ({"vary": {KEY: ("uniform", np.nan, 1.0)}}, "must be finite numbers"),
    (
        {"vary": {KEY: ("linspace", 0.2, 0.3, 2.5)}},
        "linspace takes low, high, count .whole, 1 to",
    ),
    (
        {"vary": {KEY: bytearray(b"12")}},
        "must be a list of values, or one of uniform, normal",
    ),
    (
        {"vary": {"star.mass": ("uniform", -1.0, 1.0)}},
        r">= 0 \[kg\]; it reaches from -1.0 to 1.0",
    ),
    ({"table": [1.0, 2.0]}, "table = .*: must be columns of numbers, or a .csv"),
    ({"table": [1, 2]}, "table = .*: must be columns of numbers, or a .csv"),
    ({"vary": {}, "table": {"star.mass": 2.0}}, "a column has one number for each row"),
    (
        {
            "vary": {},
            "table": {f"initial.gamma[{k}]": [0.5] * (1 + k) for k in range(3)},
        },
        "must have columns of equal length",
    ),
    ({"vary": {"payload.mass": [1.0]}}, "the scene has no payload"),
    (
        {"vary": {"star.inertia": ("uniform", 0.8, 1.2)}},
        "is a tensor: vary it with relative: true",
    ),
    ({"vary": {"control.bandwidth": [20.0]}}, "acts with control only"),
    ({"vary": {}}, "vary = {}: must name at least one key"),
    ({"vary": 3}, "vary = 3: must be a mapping from keys"),
    ({"vary": {3: [1.0]}}, r"vary\.3 = .*: must name a number"),
    ({"vary": {KEY: ("uniform", 0.2, 0.3)}, "n": None}, "n = None: must be given"),
    ({"vary": {KEY: [0.2, 0.3]}, "n": 3}, "n = 3: must be a multiple of 2"),
    ({"seed": -1}, "seed = -1: must be a whole number from 0"),
    ({"sampling": "halton"}, "sampling = 'halton': must be one of random, sobol"),
    ({"outputs": ("speed",)}, "outputs = 'speed': must be of quaternion"),
    ({"tolerance": 0.0}, "tolerance = 0.0: must be a finite number > 0"),
    ({"torque": (1.0, 2.0)}, "torque = .*: must be three finite numbers"),
    ({"steps": 2.5}, "steps = 2.5: must be a whole number"),
    ({"control": {"mode": "lqr"}}, "mode = 'lqr': must be one of feedforward"),
    ({"control": {"gain": 3.0}}, "control.gain = 3.0: unknown key; allowed are mode"),
    ({"scene": None, "scen": SCENE}, "scen = .*: unknown key; .*did you mean 'scene'"),
    ({"chunks": 5}, "chunks = 5: unknown key; .*did you mean 'chunk'"),
]


@pytest.mark.parametrize(("given", "message"), REFUSED)
def test_bad_studies_are_refused_by_key(given, message):
    values = {"scene": SCENE, "vary": {KEY: ("uniform", 0.2, 0.3)}, "n": 4} | given
    with pytest.raises(InputError, match=f"(?s){message}"):
        SweepStudy.from_values(values)


def test_a_study_refuses_what_is_no_scene():
    with pytest.raises(InputError, match="scene = 3: must be a Scene"):
        SweepStudy(3, {KEY: [0.2]})


def test_a_study_keeps_its_table_when_the_one_given_changes():
    column = np.array([1.0, 2.0])
    study = SweepStudy.from_values(
        {"scene": SCENE, "table": {"star.mass": column}, "vary": {}}
    )
    column[0] = 7.0
    assert study.table["star.mass"].tolist() == [1.0, 2.0]


@pytest.mark.parametrize("table", [{}, {"star.mass": []}])
def test_an_empty_table_is_refused(table):
    frame = pytest.importorskip("pandas").DataFrame(table, dtype=float)
    with pytest.raises(InputError, match=r"table = .*it is empty"):
        SweepStudy.from_values({"scene": SCENE, "table": frame, "vary": {}})


def test_more_rows_than_anyone_can_run_are_refused():
    values = {"scene": SCENE, "vary": {KEY: ("uniform", 0.2, 0.3)}, "n": 10**14}
    with pytest.raises(
        InputError, match="n = 100000000000000: must be a whole number from 1 to"
    ):
        SweepStudy.from_values(values)


def test_a_range_is_a_list_of_values():
    study = SweepStudy.from_values({"scene": SCENE, "vary": {"star.mass": range(1, 4)}})
    assert study.draw(0, 3)["star.mass"].ravel().tolist() == [1.0, 2.0, 3.0]


def test_a_name_that_is_too_long_is_refused():
    with pytest.raises(InputError, match="scene = 'xxx"):
        SweepStudy.from_values({"scene": "x" * 300, "vary": {"star.mass": [1.0]}})
