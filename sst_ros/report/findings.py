# SPDX-License-Identifier: Apache-2.0
"""Findings of the report of a run: warnings, which make its verdict, and notes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from enum import Enum
from typing import Any, NamedTuple

from sst_ros.recording.recording import Recording
from sst_ros.report import reference
from sst_ros.report.reference import Comparison

LEAST_ANSWERED_PERCENT = 90.0
"""A controller at the rate of the samples answers nearly all of them; one that is late
or whose commands are lost answers fewer."""


class Severity(Enum):
    """Weight of a finding."""

    WARNING = "warning"  # the run is not what was asked for
    NOTE = "note"  # how the numbers of the report are to be read


class Finding(NamedTuple):
    """A statement about a recorded run."""

    severity: Severity
    text: str


def verdict(findings: list[Finding]) -> str:
    """Return WARNING if one of the findings is a warning, else OK."""
    warned = any(finding.severity is Severity.WARNING for finding in findings)
    return "WARNING" if warned else "OK"


def texts(findings: list[Finding], severity: Severity) -> list[str]:
    """Return the texts of the findings of one severity, in their order."""
    return [finding.text for finding in findings if finding.severity is severity]


def find_all(
    run: Recording,
    integration: Comparison,
    ideal: Comparison | None,
    numbers: Mapping[str, Any],
) -> list[Finding]:
    """Return warnings, the weightiest first, then notes.

    Args:
        run: the recording.
        integration: its comparison with the same torques.
        ideal: its comparison with continuous torques, if there is one.
        numbers: the numbers of its summary.

    """
    warnings = [Finding(Severity.WARNING, text) for text in _warnings(numbers)]
    notes = [
        *_notes_on_recording(run),
        *_notes_on_comparisons(run, integration, ideal),
        *_notes_on_measurement(run, numbers),
    ]
    return warnings + [Finding(Severity.NOTE, text) for text in notes]


def _warnings(numbers: Mapping[str, Any]) -> Iterator[str]:
    """Yield what is wrong with a run, the weightiest first."""
    phase = numbers["phase"]
    if numbers["fault"]:
        yield f"fault: {numbers['fault']}"
    elif phase not in (None, "finished"):
        yield f"the run was cut short, or its recording was: last phase {phase}"
    yield from numbers["damage"]
    if numbers["samples_lost"]:
        recorded = numbers["samples_recorded_percent"]
        yield f"{numbers['samples_lost']} samples lost ({recorded:.2f} % recorded)"
    if numbers["tick_gaps"]:
        yield f"{numbers['tick_gaps']} gaps between applied torques"
    if numbers["ticks_missed"]:
        yield f"{numbers['ticks_missed']} ticks missed by the simulator"
    answered = numbers["samples_answered_percent"]
    if answered is not None and answered < LEAST_ANSWERED_PERCENT:
        age_ms = 1e3 * numbers["command_age_mean_s"]
        yield f"commands answered {answered:.3g} % of samples, mean age {age_ms:.3g} ms"
    limit = numbers["error_limit_rad"]
    errors = {
        "integration error": numbers["integration_error_gamma_rad"],
        "error estimate": numbers["simulator_error_estimate"],
    }
    for name, error in errors.items():
        if error is not None and error > limit:
            yield f"{name} {error:.1e} rad above {limit:.0e} rad"
    difference = numbers["effort_difference_max_N_m"]
    if difference and not numbers["actuators_lag"]:
        yield f"efforts differ from applied torques by {difference:.1e} N m"


def _notes_on_recording(run: Recording) -> Iterator[str]:
    """Yield what the recording says of the course of the run."""
    phase, fault = run.diagnostics.get("phase"), run.diagnostics.get("fault")
    if not run.diagnostics:
        yield (
            "no diagnostics are recorded: missed ticks and error estimates are unknown"
        )
    elif phase not in ("finished", "fault"):
        yield f"the run or its recording was cut short: the last phase is {phase}"
    if phase == "fault" or fault:
        end = float(run.seconds[-1])
        yield (
            "the run ended by a fault; it is compared up to its last sample, at "
            f"{end:.6f} s"
        )
    if not reference.begins(run):
        yield "the start of the run is not recorded; times count from the first sample"


def _notes_on_comparisons(
    run: Recording, integration: Comparison, ideal: Comparison | None
) -> Iterator[str]:
    """Yield what could not be compared."""
    moment = run.scene.moment
    pushed = bool(moment and moment.topic)
    if pushed and run.ticks.moment is None:
        yield (
            "the moment on the star came from a topic and is not recorded: nothing is "
            "compared"
        )
    left_out = len(run.time_ns) - integration.compared
    restarts = len(integration.restarts_ns)
    if restarts:
        yield (
            f"torques are missing: the reference began again {restarts} times from a "
            f"recorded sample; {left_out} samples are not compared"
        )
    elif left_out:
        yield f"{left_out} samples could not be compared"
    if ideal is None and pushed:
        yield "the moment comes from a topic: no ideal to compare with"
    if ideal is None and run.scene.torque is None:
        yield "the scene has no torques: no ideal to compare with"


def _notes_on_measurement(run: Recording, numbers: Mapping[str, Any]) -> Iterator[str]:
    """Yield what the recorded signals are, and are not."""
    if numbers["motion_of"] != "joint_states":
        rms = numbers["measurement_error_rms_rad"]
        largest = numbers["measurement_error_max_rad"]
        off = f"{rms:.1e} rad RMS, {largest:.1e} rad at most"
        if numbers["motion_of"] == "true_joint_states":
            yield (
                "integration error and energy are those of the true motion "
                "(true_joint_states), tracking is that of the measured one "
                f"(joint_states), which is off by {off}"
            )
        else:
            yield (
                f"joint_states are measured, off the orientation by {off}, and "
                "true_joint_states are not recorded: the integration error is that of "
                "the orientation; rates and energy are not compared"
            )
    if numbers["foreign_states"]:
        count = numbers["foreign_states"]
        yield f"{count} joint states of other robots are left out"
    if run.scene.lags:
        yield "the actuators lag: efforts differ from the torques that are asked for"
    if run.signals.bag.unverified:
        count = run.signals.bag.unverified
        yield f"{count} chunks have no checksum: damage would not be noticed"
    if "euler_zyz" in run.missing:
        yield ("euler_zyz is not recorded: its pictures show the orientation's angles")
