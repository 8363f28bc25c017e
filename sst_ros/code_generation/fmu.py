# SPDX-License-Identifier: Apache-2.0
"""The equations of a scene as a Functional Mock-up Unit (FMI 3.0, fmi-standard.org).

A unit is a zip file with a description of its variables, the C source of the equations,
the functions of the interface around them, and their binary for this platform where a C
compiler is at hand. Torques are inputs and are clamped to the limit of the actuators.
"""

from __future__ import annotations

import io
import platform
import shutil
import subprocess
import tempfile
import uuid
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from sst_ros.code_generation.c_source import c_files, identifier
from sst_ros.code_generation.named_programs import SceneEquations
from sst_ros.errors import SstError
from sst_ros.files import load_templates
from sst_ros.integration.methods import DOP853
from sst_ros.scene.loads import JOINTS, MOMENTS
from sst_ros.version import VERSION

STATES = (
    *(f"quaternion_{axis}" for axis in "xyzw"),
    *(f"body_rate_{axis}" for axis in "xyz"),
    *(f"actuator_torque_{leg}" for leg in (1, 2, 3)),
)
TORQUE_INPUTS = tuple(f"torque_{leg}" for leg in (1, 2, 3))
MOMENT_INPUTS = MOMENTS
FMU_OUTPUTS = (
    *JOINTS,
    *(f"{name}_rate" for name in JOINTS),
    "kinetic_energy",
    "potential_energy",
)
# of STATES and FMU_OUTPUTS, in their order
STATE_UNITS = ("1",) * 4 + ("rad/s",) * 3 + ("N.m",) * 3
OUTPUT_UNITS = ("rad",) * len(JOINTS) + ("rad/s",) * len(JOINTS) + ("J", "J")
FMU_UNITS: dict[str, dict[str, int]] = {
    "1": {},
    "rad": {"rad": 1},
    "rad/s": {"rad": 1, "s": -1},
    "N.m": {"kg": 1, "m": 2, "s": -2},
    "J": {"kg": 1, "m": 2, "s": -2},
    "s": {"s": 1},
}
"""Powers of the base units of SI that FMI wants for a unit."""

PLATFORMS = {("Linux", "x86_64"): "x86_64-linux", ("Linux", "aarch64"): "aarch64-linux"}
FLAGS = ("-std=c99", "-O2", "-fvisibility=hidden", "-shared", "-fPIC")
# of the files in the zip, so that equal scenes give equal bytes
EPOCH = (1980, 1, 1, 0, 0, 0)


def fmu_file(equations: SceneEquations) -> dict[str, bytes]:
    """Write the unit, by its name.

    A RuntimeWarning says that there is no C compiler, and so no binary in it.
    """
    name = identifier(equations)
    model = SceneEquations(
        equations.scene, equations.parameters, ("derivative", "joints", "energies")
    )
    templates = load_templates("code_generation")
    contents = f"{VERSION} {model.scene_hash} {model.parameters}"
    token = str(uuid.uuid5(uuid.NAMESPACE_URL, contents))
    stages = len(DOP853.c)
    stage_rows = [[*row, *[0.0] * (stages - len(row))] for row in DOP853.a]
    sources = c_files(model)
    sources["fmi3.c"] = templates.get_template("fmi3.c").render(
        name=name,
        token=token,
        states=model.state.size,
        inputs=sum(argument.size for argument in model.acting),
        parameters=model.parameters,
        torque_limit=model.scene.torque_limit,
        stages=stages,
        stage_rows=stage_rows,
        weights=DOP853.b,
        fifth=DOP853.error,
        third=DOP853.damping,
    )
    description = templates.get_template("modelDescription.xml").render(
        name=name,
        title=model.scene.name,
        token=token,
        description=(
            f"{model.scene.description} SHA-256 of the scene: {model.scene_hash}"
        ),
        version=VERSION,
        units=FMU_UNITS,
        duration=model.scene.duration,
        variables=[*_variables(model)],
        structure=[*_structure(model)],
    )
    build = templates.get_template("buildDescription.xml").render(name=name)
    files: dict[str, str | bytes] = {"modelDescription.xml": description}
    files["sources/buildDescription.xml"] = build
    files |= {f"sources/{file}": text for file, text in sources.items()}
    files |= _binary(name, sources)
    return {f"{name}.fmu": _pack(files)}


def _pack(files: Mapping[str, str | bytes]) -> bytes:
    """Return files by path as a zip file; equal files give equal bytes."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as unit:
        for path, content in files.items():
            unit.writestr(zipfile.ZipInfo(path, EPOCH), content, zipfile.ZIP_DEFLATED)
    return packed.getvalue()


def _variables(equations: SceneEquations) -> Iterator[dict[str, Any]]:
    """Yield the attributes of each variable, in the order of value references."""
    continuous = {"variability": "continuous"}
    fixed = {"causality": "parameter", "variability": "fixed", "initial": "exact"}
    rows: list[dict[str, Any]] = []
    rows.append({"name": "time", "causality": "independent", "unit": "s", **continuous})
    states = STATES[: equations.state.size]
    for name, unit, start in zip(states, STATE_UNITS, equations.initial, strict=False):
        row = {"name": name, "causality": "output", "unit": unit, **continuous}
        rows.append({**row, "initial": "exact", "start": repr(start)})
    for reference, name in enumerate(states, start=1):  # time has the reference 0
        row = {"name": f"der({name})", "causality": "local", **continuous}
        rows.append({**row, "initial": "calculated", "derivative": reference})
    inputs = (TORQUE_INPUTS, MOMENT_INPUTS)  # there is a moment if a topic gives it
    for argument, names in zip(equations.acting, inputs, strict=False):
        for name, quantity in zip(names, argument.quantities, strict=True):
            row = {"name": name, "start": "0.0", "causality": "input", "unit": "N.m"}
            rows.append({**row, "description": quantity, **continuous})
    for name, unit in zip(FMU_OUTPUTS, OUTPUT_UNITS, strict=True):
        row = {"name": name, "causality": "output", **continuous}
        rows.append({**row, "initial": "calculated", "unit": unit})
    quantities = [text for argument in equations.open for text in argument.quantities]
    for name, value, text in zip(
        equations.parameters, equations.values, quantities, strict=True
    ):
        rows.append({"name": name, "start": repr(value), "description": text, **fixed})
    text = (
        "Co-Simulation: length of a step [s]; 0 for steps that an error estimate"
        " controls"
    )
    row = {"name": "step", "start": "0.0", "unit": "s", "description": text}
    rows.append({**row, **fixed})
    for reference, row in enumerate(rows):
        yield {"valueReference": reference} | row


def _structure(equations: SceneEquations) -> Iterator[tuple[str, int]]:
    """Yield the outputs, derivatives and initial unknowns by value reference."""
    size = equations.state.size
    states = range(1, 1 + size)
    derivatives = range(1 + size, 1 + 2 * size)
    first = 1 + 2 * size + sum(argument.size for argument in equations.acting)
    outputs = range(first, first + len(FMU_OUTPUTS))
    yield from (("Output", reference) for reference in (*states, *outputs))
    yield from (("ContinuousStateDerivative", reference) for reference in derivatives)
    yield from (("InitialUnknown", reference) for reference in (*derivatives, *outputs))


def _binary(name: str, sources: dict[str, str]) -> dict[str, bytes]:
    """Compile the sources for this platform.

    Return the binary by its path in the unit.
    """
    compiler = shutil.which("cc")
    folder = PLATFORMS.get((platform.system(), platform.machine()))
    if compiler is None or folder is None:
        reason = "cc is not installed" if compiler is None else "not for this platform"
        message = f"no binary in the unit ({reason}): importers compile its sources"
        warnings.warn(message, RuntimeWarning, stacklevel=4)
        return {}
    with tempfile.TemporaryDirectory() as place:
        for file, text in sources.items():
            (Path(place) / file).write_text(text, encoding="utf-8")
        units = [file for file in sources if file.endswith(".c")]
        command = [compiler, *FLAGS, "-o", f"{name}.so", *units, "-lm"]
        compilation = subprocess.run(
            command, cwd=place, capture_output=True, text=True, check=False
        )
        if compilation.returncode != 0:
            error_lines = compilation.stderr.strip().splitlines()
            failure = error_lines[0] if error_lines else compilation.returncode
            raise SstError(f"the C compiler cc failed: {failure}")
        return {
            f"binaries/{folder}/{name}.so": (Path(place) / f"{name}.so").read_bytes()
        }
