# SPDX-License-Identifier: Apache-2.0
"""equations(): the equations of motion of a scene for other programs and languages.

The package traces its dynamics into straight-line programs (`programs.expression`).
Here they are written out: as C, as a module of Python on the numbers of another
library, as a unit of the Functional Mock-up Interface, or as a model of MuJoCo.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from sst_ros.code_generation.c_source import c_files, identifier
from sst_ros.code_generation.fmu import fmu_file
from sst_ros.code_generation.named_programs import CALLER, SceneEquations
from sst_ros.code_generation.python_module import LIBRARIES, python_module
from sst_ros.description.mjcf import mjcf
from sst_ros.errors import check_kinds, refuse_unless, require
from sst_ros.files import replace_file, require_free, write_into
from sst_ros.programs.expression import execute
from sst_ros.scene.scene import SceneInput, scene_of
from sst_ros.state import Explained, cached_property

WRITERS: dict[str, Callable[[SceneEquations], Mapping[str, str | bytes]]] = {
    "c": c_files,
    "fmu": fmu_file,
}
"""What writes the files of each target beside the libraries of Python and MuJoCo."""

MJCF = "mjcf"
TARGETS = ("c", *LIBRARIES, "fmu", MJCF)


class Equations(Explained):
    """The equations of a scene, written for a target.

    For a library of Python the functions are attributes by the names of `outputs`, as
    in `equations("swing", "jax").derivative`; the library is imported at the first one.

    Attributes:
        target: one of TARGETS.
        files: the contents by the name of the file.
        outputs: names of the equations that are in them.
        parameters: values in the scene of the numbers that are open, by key.
        initial_state: the state at t = 0, numbers as the equations take them.

    """

    def __init__(
        self,
        target: str,
        files: Mapping[str, str | bytes],
        outputs: tuple[str, ...],
        parameters: Mapping[str, float],
        initial_state: tuple[float, ...],
    ) -> None:
        self.target = target
        self.files = dict(files)
        self.outputs = outputs
        self.parameters = dict(parameters)
        self.initial_state = initial_state

    def __getattr__(self, name: str) -> Any:
        # Called for names alone that are no attribute; those of `outputs` are
        # functions.
        outputs = self.__dict__.get("outputs", ())
        if name not in outputs or self.target not in LIBRARIES:
            raise AttributeError(
                f"equations for {self.__dict__.get('target')} have no {name!r}"
            )
        return self._functions[name]

    def write(self, folder: str | Path, *, force: bool = False) -> list[Path]:
        """Write the files into a folder, and return their paths.

        InputError is raised where a file would be overwritten and `force` is not set.
        """
        paths = [Path(folder) / name for name in self.files]
        for path in paths:
            require_free(path, CALLER, force=force)
        with write_into(Path(folder), CALLER):
            for path, content in zip(paths, self.files.values(), strict=True):
                with replace_file(path) as own:
                    raw = content if isinstance(content, bytes) else content.encode()
                    own.write_bytes(raw)
        return paths

    @cached_property
    def _functions(self) -> dict[str, Any]:
        """Names of the module for a library of Python."""
        require(self.target)
        (name, text), *_ = self.files.items()
        functions: dict[str, Any] = {"__name__": Path(name).stem}
        execute(text, functions, name)
        return functions

    def _facts(self) -> dict[str, object]:
        return {
            "target": self.target,
            "files": [*self.files],
            "equations": self.outputs or "all, as the engine has them",
            "parameters": ", ".join(self.parameters) or "none",
        }


@check_kinds
def equations(
    scene: SceneInput,
    target: str,
    *,
    parameters: Collection[str] = (),
    outputs: Collection[str] | None = None,
) -> Equations:
    """Write the equations of motion of a scene for another program.

    Args:
        scene: name or path of a scene, its document as a dict, or a `Scene`.
        target: "c" (C99 with its header), "numpy", "jax", "casadi", "mpmath" or "sympy"
            (a module of Python, whose functions the result has too), "fmu" (FMI 3.0,
            Model Exchange and Co-Simulation) or "mjcf" (the mechanism for MuJoCo).
        parameters: keys of numbers of the scene that stay open, as "star.inertia.zz",
            "payload.mass" or "friction.gamma.viscous", but not of its geometry; the
            functions take their values as the last argument. A vector means each of its
            components, a list each of its entries.
        outputs: which equations, of "derivative", "joints", "energies",
            "derivative_by_state", "derivative_by_torque", "derivative_by_parameters";
            by default all. "fmu" and "mjcf" have what their formats ask for.

    Raises:
        InputError: an argument is not allowed, or the scene has what the target lacks.
        AssemblyError: the initial gamma has no unique admissible assembly.

    """
    loaded_scene = scene_of(scene)
    model_target = target in ("fmu", MJCF)
    refuse_unless(
        CALLER,
        ("target", target, target in TARGETS, f"must be one of {', '.join(TARGETS)}"),
        (
            "outputs",
            outputs,
            not (model_target and outputs),
            f"are fixed for {target}: give none",
        ),
        (
            "parameters",
            parameters,
            not (target == MJCF and parameters),
            "are not for mjcf: MuJoCo changes the numbers of its own model",
        ),
    )
    output_names = None if outputs is None else tuple(outputs)
    if model_target:  # traces what its format asks for by itself
        output_names = ()
    traced = SceneEquations(loaded_scene, tuple(parameters), output_names)
    values = dict(zip(traced.parameters, traced.values, strict=True))
    name = identifier(traced)
    if target == MJCF:
        files: Mapping[str, str | bytes] = {f"{name}.xml": mjcf(loaded_scene)}
    elif target in LIBRARIES:
        text = python_module(traced, LIBRARIES[target])
        files = {f"{name}_{target}.py": text}
    else:
        files = WRITERS[target](traced)
    return Equations(target, files, traced.outputs, values, traced.initial)
