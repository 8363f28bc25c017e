# SPDX-License-Identifier: Apache-2.0
"""identify(): constants of a scene from a recorded or simulated motion.

Torques are fitted by weighted least squares on the inverse dynamics, which is linear in
most of them. Any other constant is found by simulation: the motion that fits measured
angles.

Noise of the angles shrinks estimates (errors in variables), and a lower cut-off of the
angles would change the motion itself. So the regressor is made of angles filtered
little, and then torques and columns alike are projected on the m sines of lowest
frequency,

    sqrt(2 / (n + 1)) sum over i of x_i sin(pi i k / (n + 1)), k = 1 to m.

What holds for samples holds for the components (Gautier, Proc. IEEE ICRA 1997,
1922-1927). The sines are orthonormal, so that white noise stays white, and vanish at
both ends, where cosines or sums would leave noise of the rates (Shinbrot, Trans. ASME
79 (1957) 547-552). docs/howto/identify.md has the bias with and without them, measured.

What was measured of the angles at a time is what they were a delay before, of sensors
and of what transports their readings. The delay is one more unknown, in which the
torques are not linear: by Gauss-Newton, beside the base parameters. Its column is the
derivative of the residuals, so that the standard deviations of the others hold its
uncertainty, too.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular

from sst_ros.errors import check_kinds, refuse_unless
from sst_ros.identification import contradictions, parameters
from sst_ros.identification.consistency import scales
from sst_ros.identification.measured_motion import Measured, Segments, read_segments
from sst_ros.identification.parameters import BaseParameters, Identification, Regressor
from sst_ros.identification.regression import (
    LONGEST_DELAY,
    SIGNIFICANT,
    RegressionEquations,
)
from sst_ros.identification.simulation_fit import fit_simulation
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import Scene, SceneInput, scene_of
from sst_ros.state import finite_vector

STILL = 1e-6  # range of gamma [rad] below which a motion is none
INEXPLICABLE = 250.0  # chi^2 from which other signs and orders of torques are tried


@dataclass(frozen=True)
class TorqueFit(Identification):
    """Constants identified by torques; its estimates are those of the base parameters.

    Attributes:
        base: the combinations of parameters that the motion determines; `estimate` is
            without the constraint that bodies can exist.
        noise: standard deviations of the torques [N m], shape (3,).
        condition: condition number of the weighted regressor with columns of length
            one.
        excess: chi^2 of `values` against the estimates.
        vague: combinations whose standard deviation exceeds their size.
        samples: of the torques that were fitted.
        band: frequency below which they were [Hz]; None where angles were not filtered.
        delay: of the measured angles [s].
        delay_deviation: its standard deviation [s]; None where the delay was given, or
            is none.

    """

    base: BaseParameters
    noise: Array
    condition: float
    excess: float
    vague: tuple[str, ...]
    samples: int
    band: float | None
    delay: float = 0.0
    delay_deviation: float | None = None

    @property
    def consistent(self) -> bool:
        """Whether bodies that can exist explain the estimates.

        They have to explain them within their uncertainty.
        """
        return self.excess < SIGNIFICANT

    @property
    def largest_correlation(self) -> tuple[float, str, str] | None:
        """The largest correlation of two estimates, and their parameters.

        None for one alone.
        """
        correlation = self.correlation
        sizes = np.abs(np.triu(correlation, 1))
        if sizes.size < 2:
            return None
        row, column = np.unravel_index(int(np.argmax(sizes)), sizes.shape)
        names = [self.names[index] for index in self.base.chosen]
        return float(correlation[row, column]), names[row], names[column]


@check_kinds
def identify(
    data: Measured | str | Path,
    scene: SceneInput | None = None,
    parameters: Collection[str] | None = None,
    method: str = "inverse_dynamics",
    *,
    cutoff: float | None = None,
    noise: ArrayLike | None = None,
    delay: float | None = None,
) -> Identification:
    """Identify constants of a scene from a motion.

    By inverse dynamics: torques are linear in inertial parameters, friction
    coefficients, stiffness and rotor inertia; weighted least squares gives the
    combinations of them that the motion determines, with their covariance, and the
    nearest scene whose bodies can exist.

    By simulation: the motion is integrated from the initial state of the scene, and
    nonlinear least squares fits it to measured angles by any number of the scene
    ("friction.gamma.smoothing", "actuators.time_constant", "stroke.restitution",
    "initial.gamma_dot[0]").

    Args:
        data: a recording or its path, a `Trajectory`, or a mapping of arrays: t [s],
            gamma [rad] (n, 3), torque [N m] (n, 3), and where they are known gamma_dot
            [rad/s] (n, 3), quaternion (4,) at the first sample, held (torques act to
            the next sample), mu and beta [rad] (n, 3), by which the angles are checked.
            Angles may wrap, times may be those of an epoch, uneven, and have gaps: what
            was done about it is in `warnings`.
        scene: what is known of the manipulator, and the values to start from; by
            default the scene of the data.
        parameters: names of unknowns, by inverse dynamics also how their names begin
            ("star", "friction.gamma", "offset"), and by default the bodies, friction,
            springs and rotors that the scene has.
        method: "inverse_dynamics" or "simulation".
        cutoff: of the zero-phase filter of the angles [Hz]; by default none where rates
            were measured, else ten times the bandwidth of the motion.
        noise: standard deviations of the torques [N m], three; by default estimated.
        delay: how long before its stamp a measured angle was what it says, against the
            torques [s]; by default estimated where angles are filtered, else none.

    Returns:
        A `TorqueFit` by inverse dynamics, a `SimulationFit` by simulation.

    Raises:
        InputError: the data are not sound, the motion determines nothing, or an
            argument is not allowed.

    """
    exists = method in ("inverse_dynamics", "simulation")
    refuse_unless(
        "identify", ("method", method, exists, "must be inverse_dynamics or simulation")
    )
    if isinstance(data, (str, Path)):
        # needs rosbags, which other data do not
        from sst_ros.recording.recording import read

        data = read(data)
    start: Any = scene if scene is not None else getattr(data, "scene", None)
    refuse_unless(
        "identify", ("scene", None, start is not None, "must be given with arrays")
    )
    start = scene_of(start)
    if method == "inverse_dynamics":
        return fit_torques(data, start, parameters, cutoff, noise, delay)
    plain = cutoff is None and noise is None and delay is None
    refuse_unless(
        "identify", ("method", method, plain, "takes no cutoff, noise or delay")
    )
    return fit_simulation(data, start, parameters)


def fit_torques(
    data: Measured,
    scene: Scene,
    requested: Iterable[str] | None,
    cutoff: float | None,
    noise: ArrayLike | None,
    delay: float | None,
) -> TorqueFit:
    """Identify by torques; arguments as for `identify`."""
    names = parameters.select_names(scene, requested)
    segments = read_segments(data)
    deviations = finite_vector(noise)
    _check_request(segments, scene, requested, names, noise, delay)
    notes = contradictions.check_angles(segments.motion)
    equations = RegressionEquations(segments.parts, Regressor(scene, names), cutoff)
    fitted = equations.fit(deviations, delay)
    other_units = contradictions.check_energy(*equations.compare_energies(fitted))
    values, excess = equations.find_bodies(fitted)
    if excess > INEXPLICABLE and not other_units:
        equations.refuse_relabelled(fitted, deviations, delay)
    base = fitted.base
    root = fitted.root
    before = parameters.values(scene, names)
    inverse = solve_triangular(root, np.eye(len(root)))
    deviation = np.linalg.norm(inverse, axis=1)
    mechanism = parameters.find_base_parameters(equations.regressor)
    undetermined = [index not in base.chosen for index in mechanism.chosen]
    vague = deviation > scales(names, before)[base.chosen]
    source = f"identified from {fitted.samples} samples"
    return TorqueFit(
        scene=parameters.with_parameters(scene, names, values, source),
        names=names,
        values=values,
        labels=base.labels,
        before=np.asarray(base.transform @ before),
        estimate=fitted.estimate,
        covariance=inverse @ inverse.T,
        undetermined=tuple(compress(mechanism.labels, undetermined)),
        warnings=(
            *segments.notes,
            *equations.notes,
            *fitted.notes,
            *other_units,
            *notes,
        ),
        base=base,
        noise=fitted.noise,
        condition=float(np.linalg.cond(root / np.linalg.norm(root, axis=0))),
        excess=excess,
        vague=tuple(compress(base.labels, vague)),
        samples=fitted.samples,
        band=equations.band,
        delay=fitted.delay,
        delay_deviation=fitted.delay_deviation,
    )


def _check_request(
    segments: Segments,
    scene: Scene,
    requested: Iterable[str] | None,
    names: tuple[str, ...],
    noise: ArrayLike | None,
    delay: float | None,
) -> None:
    """Refuse a motion at rest, no parameters, and a noise or delay that none has."""
    travel = max(
        float(np.ptp(segment.gamma, axis=0).max()) for segment in segments.parts
    )
    moves = travel >= STILL or scene.gravity is not None
    deviations = finite_vector(noise)
    positive = noise is None or (deviations is not None and min(deviations) > 0.0)
    searched = delay is None or abs(delay) <= LONGEST_DELAY
    still = f"moves by less than {STILL:g} rad: a manipulator at rest shows no inertia"
    range_of_delay = f"must be from -{LONGEST_DELAY:g} to {LONGEST_DELAY:g} s"
    three = "must be three finite standard deviations > 0 [N m]"
    refuse_unless(
        "identify",
        ("gamma", travel, moves, still),
        ("parameters", requested, bool(names), "must name one or more"),
        ("noise", noise, positive, three),
        ("delay", delay, searched, range_of_delay),
    )
