# SPDX-License-Identifier: Apache-2.0
"""The tests that `colcon test` runs, and `pytest` without a path."""

from pathlib import Path

ON_A_PLATFORM = (
    # the package and the linters of ROS
    *("test_ament_lint.py", "test_imports.py", "test_light_imports.py"),
    "test_packaging.py",
    # NumPy, SciPy, pandas, matplotlib and LLVM, by what each room takes from them
    *("mechanism", "dynamics", "runtime"),
    *("programs/test_cold_processes.py", "programs/test_machine_code.py"),
    *("programs/test_tanh.py", "programs/test_trace.py"),
    *("integration/test_batch.py", "integration/test_event_times.py"),
    *("integration/test_method_steps.py", "integration/test_methods.py"),
    *("integration/test_stepper.py", "integration/test_transitions.py"),
    *("test_simulate.py", "test_simulation.py", "test_trajectory.py"),
    *("control/test_inverse.py", "control/test_linearize.py"),
    *("control/test_motions.py", "description/test_urdf.py"),
    *("identification/test_identify.py", "recording/test_storage.py"),
    *("report/test_scene_summary.py", "report/test_stability_report.py"),
    "sweeps/test_sweep.py",
    # rclpy, the middleware and signals
    *("nodes", "ros/test_control.py", "ros/test_lockstep.py", "ros/test_messages.py"),
    *("ros/test_parameters.py", "ros/test_process.py", "ros/test_recorder.py"),
    *("ros/test_sensors.py", "ros/test_simulator.py", "ros/test_start_and_end.py"),
    "ros/test_torque_player.py",
)
"""What `colcon test` runs: what can fail on one platform and pass on another.

Each library and each room is used once. What our own statements decide alone (refusals,
pages, proofs, studies, structure) is the same everywhere: `make test` runs it.
"""


def pytest_configure(config):
    """Choose what colcon runs, which chooses nothing: no slow tests, `ON_A_PLATFORM`.

    So does `pytest` without a path. With a path all tests that are not slow run there,
    with `-m` or the name of a test what it asks for.
    """
    if config.option.markexpr or any("::" in word for word in config.args):
        return
    config.option.markexpr = "not slow"
    source = getattr(config, "args_source", None)  # since pytest 7.2
    if source is not None and source.name != "ARGS":
        config.args = [str(Path(__file__).parent / name) for name in ON_A_PLATFORM]
