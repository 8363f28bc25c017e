# SPDX-License-Identifier: Apache-2.0
"""Parameters as arrays: every row is the scene with these numbers in its document."""

import dataclasses

import numpy as np
import pytest
from loaded_scenes import IGNORE, REST, loaded
from slow_cases import slow_except

from sst_ros import load_scene
from sst_ros.dynamics.initial_state import NO_RATE
from sst_ros.errors import InputError
from sst_ros.integration.batch import Batch
from sst_ros.integration.methods import RK4
from sst_ros.mechanism import workspace
from sst_ros.mechanism.geometry import Geometry
from sst_ros.programs.expression import compile_program
from sst_ros.scene.loads import Actuators
from sst_ros.scene.scene import Scenarios
from sst_ros.scene.yaml_document import find_fields

EXAMPLE2 = load_scene("example2_heavy")
HOME = np.pi / 4


RANGES = {
    "star.mass": (0.5, 1.0, True),
    "star.inertia.zz": (0.95, 1.05, False),
    "payload.mass": (0.5, 1.5, False),
    "payload.centre": (0.8, 1.1, True),
    "gravity.acceleration": (0.5, 1.5, True),
    "friction.gamma.viscous": (0.5, 1.5, True),
    "friction.gamma.coulomb": (0.5, 1.0, True),
    "friction.gamma.static": (1.0, 1.5, True),
    "friction.gamma.smoothing": (0.5, 1.5, False),
    "friction.gamma.stribeck": (0.5, 1.5, False),
    "friction.mu.viscous": (0.5, 1.5, True),
    "friction.mu.coulomb": (0.5, 1.5, True),
    "friction.beta.viscous": (0.5, 1.5, True),
    "springs[0].rest": (0.5, 1.5, True),
    "springs[1].stiffness": (0.5, 1.5, True),
    "actuators.rotor_inertia": (0.5, 1.5, True),
    "actuators.gear_ratio": (0.5, 1.5, False),
    "actuators.time_constant": (0.5, 1.5, False),
    "stroke.stiffness": (0.5, 1.5, False),
    "stroke.damping": (0.5, 1.5, True),
    "actuated_links[2].mass": (0.9, 1.0, True),
    "actuated_links[2].inertia.xz": (0.9, 1.0, True),
    "intermediate_links[0].inertia.xy": (0.5, 1.1, True),
    "intermediate_links[1].inertia.zz": (0.99, 1.0, False),
    "base.v": (0.9, 1.1, False),
    "workspace.beta_max_deg": (0.5, 1.0, False),
    "torque.amplitude": (0.5, 1.5, True),
    "torque.frequency": (0.5, 1.5, True),
}
"""Factors of what the document says, and whether zero is allowed too."""

LOADED = dataclasses.replace(
    loaded(),
    stroke=load_scene("elastic_stops").stroke,
    torque=EXAMPLE2.torque,
    actuators=dataclasses.replace(loaded().actuators, torque_limit=None),
)


def drawn(seed):
    """Some numbers of a scene with every term, three rows of each, zero in some of
    them.
    """
    rng, found = np.random.default_rng(seed), {}
    for key, (low, high, may_vanish) in RANGES.items():
        if rng.random() < 0.3:
            factors = rng.uniform(low, high, 3)
            if may_vanish:
                factors[rng.random(3) < 0.3] = 0.0
            found[key] = np.multiply.outer(factors, np.array(eval(f"LOADED.{key}")))
    return found


STATE = (0.1, -0.3, 0.2, 0.9, 1.0, -2.0, 0.5, 0.3, -0.2, 0.1)
DRIVE = (0.4, -0.1, 0.2)


@pytest.mark.parametrize("seed", slow_except(range(6), range(30)))
def test_programs_have_the_bits_of_those_of_each_row(seed):
    """Zero in one row and not in another is one program.

    Nothing but the inputs differs.
    """
    batch = Batch(LOADED, RK4, profile=True, parameters=drawn(seed))
    columns = batch.drives(REST, 3)
    for row in range(3):
        own = Batch(batch.scenario(row), RK4, profile=True)
        at, drive = (0.1, *STATE), (*DRIVE, *columns[3:, row])
        assert compile_program(batch.model.program)(*at, *drive) == compile_program(
            own.model.program
        )(*at, *DRIVE)
        inside = compile_program(batch.model.limit_distances)(
            *STATE[:7], *columns[3:, row]
        )
        assert inside == compile_program(own.model.limit_distances)(*STATE[:7])


def test_what_is_the_same_in_all_rows_costs_nothing():
    same = {"star.inertia.zz": [0.3] * 3, "actuators.time_constant": [5e-3] * 3}
    batch = Batch(LOADED, RK4, parameters=same)
    assert batch.model.program == Batch(batch.scenario(0), RK4).model.program


def test_other_values_are_the_same_code():
    def programs(low, high):
        batch = Batch(EXAMPLE2, RK4, parameters={"star.inertia.zz": [low, high]})
        return batch.programs.traced

    assert programs(0.2, 0.3) == programs(0.25, 0.4)


def test_commands_are_limited_as_those_of_a_simulation():
    scene = load_scene("fast_spin")
    scene = dataclasses.replace(scene, actuators=Actuators(torque_limit=1.0))
    batch = Batch(scene, RK4, parameters={"actuators.torque_limit": [0.5, 2.0]})
    asked = (3.0, -1.0, 0.2)
    np.testing.assert_array_equal(
        batch.drives(asked, 2)[:3].T, [(0.5, -0.5, 0.2), (2.0, -1.0, 0.2)]
    )


def test_a_singular_start_stops_no_other():
    """Where det J2 = 0 gamma_dot says nothing of the body rate; rest stays rest."""
    odd = (210.0, 75.0, 75.0)
    scene = dataclasses.replace(EXAMPLE2, **IGNORE)
    of_odd = dataclasses.replace(
        scene, star=dataclasses.replace(scene.star, alpha_deg=odd)
    )
    geometry = Geometry.of(of_odd)
    chart = workspace.over_orientations(
        geometry, workspace.triangle_directions(geometry, 12)[0]
    )
    gamma = workspace.parallel_singularities(chart).gamma[0]
    batch = Batch(
        scene, RK4, parameters={"star.alpha_deg": [odd, scene.star.alpha_deg]}
    )
    y, code = batch.initial(gamma, REST)
    assert code.tolist() == [0, 0]
    assert np.all(y[4:7] == 0.0)
    assert batch.initial(gamma, (1.0, 0.0, 0.0))[1].tolist() == [NO_RATE, 0]


def test_valid_rows_are_prepared_without_a_scene_for_each(monkeypatch):
    """Columns are checked and prepared as arrays, zeros too."""
    built = []
    scene = Scenarios.scene
    monkeypatch.setattr(
        Scenarios, "scene", lambda self, row: built.append(row) or scene(self, row)
    )
    rng = np.random.default_rng(3)
    parameters = {
        "star.inertia.zz": rng.uniform(0.25, 0.3, 1000),
        "intermediate_links[1].inertia.xx": rng.uniform(8e-6, 1e-5, 1000),
        "torque.amplitude": rng.uniform(0.5, 4.0, (1000, 3)),
        "base.v": np.array(EXAMPLE2.base.v) + rng.uniform(-0.05, 0.05, (1000, 3, 3)),
        "star.alpha_deg": 120.0 + rng.uniform(-3.0, 3.0, (1000, 1)) * (1.0, 0.0, -1.0),
    }
    Batch(EXAMPLE2, RK4, profile=True, parameters=parameters)
    assert not built
    parameters["torque.amplitude"][500] = 0.0
    Batch(EXAMPLE2, RK4, profile=True, parameters=parameters)
    assert not built


REFUSED = [
    (
        {"star.weight": [1.0]},
        r"star.weight = \[1.0\]: unknown key; allowed are inertia, mass",
    ),
    ({"payload.mass": [1.0]}, "payload.mass = .*: the scene has no payload"),
    ({"springs[0].rest": [1.0]}, "the scene has 0 springs"),
    ({"actuated_links[3].mass": [1.0]}, "the scene has 3 actuated_links"),
    ({"star.inertia": [1.0]}, "must name a number, as star.mass does"),
    ({"stroke.at_end": [1.0]}, "must name a number, as star.mass does"),
    ({"base.v[0]": np.ones((2, 3))}, "must name a number, as star.mass does"),
    (
        {"base.v": np.eye(3)},
        r"must have the shape \(N, 3, 3\), a row a scenario; it has \(3, 3\)",
    ),
    ({"base.radius": 1.0}, r"must have the shape \(N,\)"),
    ({"base.radius": []}, r"must have the shape \(N,\)"),
    ({"star.inertia.zz": ["much"]}, "must be numbers"),
    (
        {"star.inertia.zz": [0.3, 0.3], "star.inertia.xx": [0.3]},
        r"must have the shape \(2,\)",
    ),
    (
        {"actuated_links.mass": [0.0], "actuated_links[1].mass": [0.0]},
        r"actuated_links\[1\].mass = .*: is given twice",
    ),
    (
        {"star.inertia.zz": [0.3, -1.0]},
        r"scenario 1: star.inertia = .*: principal moments of inertia must be > 0",
    ),
    (
        {"actuated_links[2].mass": [0.0, -1.0]},
        (
            r"scenario 1: actuated_links\[2\].mass = -1.0: must be a finite number >= 0"
            r" \[kg\]"
        ),
    ),
    (
        {"star.inertia.zz": [0.3, np.nan]},
        "scenario 1: star.inertia.zz = nan: must be a finite",
    ),
    (
        {"actuated_links[0].centre": [(0.0, 0.0, np.nan)]},
        r"scenario 0: actuated_links\[0\].centre",
    ),
    (
        {"star.alpha_deg": [(120.0, 120.0, 121.0)]},
        "scenario 0: star.alpha_deg = .*must sum to 360",
    ),
    (
        {"stroke.restitution": [0.5, 0.6]},
        (
            "scenario 0: stroke.restitution = 0.5: is given with at_end: elastic, and"
            " only there"
        ),
    ),
    ({"initial.gamma": np.ones((2, 3))}, "initial.gamma = .*: is given to run"),
    (
        {"torque.amplitude": np.ones((2, 3))},
        "torque.amplitude = .*: acts with profile=True only",
    ),
    ({"duration": [1.0, 2.0]}, "duration = .*: has no effect on a batch"),
]


@pytest.mark.parametrize(("parameters", "said"), REFUSED)
def test_bad_parameters_are_refused_by_key_and_row(parameters, said):
    with pytest.raises(InputError, match=f"(?s){said}"):
        Batch(EXAMPLE2, parameters=parameters)


def test_numbers_of_a_term_that_is_left_out_are_checked_too():
    """Friction of zero is none, but its smoothing is no less wrong."""
    values = {"viscous": [0.0, 0.1], "coulomb": [0.0, 0.1], "smoothing": [-1.0, 0.1]}
    said = (
        "scenario 0: friction.beta.smoothing = -1.0: must be a finite number >= 1e-12"
    )
    with pytest.raises(InputError, match=said):
        Batch(
            LOADED,
            parameters={f"friction.beta.{key}": rows for key, rows in values.items()},
        )


SPREAD = {
    "star.inertia.zz": (0.5, 1.6),
    "star.inertia.xy": (-40.0, 40.0),
    "star.mass": (0.5, 3.0),
    "star.centre": (-1.5, 1.5),
    "base.radius": (-0.5, 1.5),
    "payload.inertia.xx": (-0.2, 3.0),
    "friction.gamma.static": (0.3, 1.5),
    "intermediate_links[1].inertia.zz": (0.2, 2.0),
    "base.v": (-0.2, 1.5),
}


@pytest.mark.parametrize("key", SPREAD)
def test_rules_refuse_the_same_rows_as_columns_and_as_scenes(key):
    low, high = SPREAD[key]
    value = np.array(next(find_fields(LOADED, key))[1])
    factors = np.random.default_rng(5).uniform(low, high, (60, *value.shape))
    scenarios = Scenarios(LOADED, {key: factors * value})
    refused = set()
    for row in range(60):
        try:
            scenarios.scene(row)
        except InputError:
            refused.add(row)
    assert 0 < len(refused) < 60
    assert (
        set(scenarios.faults(most=60))
        == refused
        == set(np.flatnonzero(scenarios._doubtful()))
    )


def test_no_more_than_ten_problems_are_told():
    with pytest.raises(InputError) as refused:
        Batch(EXAMPLE2, parameters={"star.inertia.zz": np.full(1000, -1.0)})
    assert len(refused.value.problems) == 10
