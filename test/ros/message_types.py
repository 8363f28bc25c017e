# SPDX-License-Identifier: Apache-2.0
"""Python packages of the message types that no wheel has, made by the rosidl of the
wheels.

The definitions are fields alone, as the published packages have them: type hashes
(RIHS01), which depend on nothing else, are compared with those of control_msgs 6.8.0
and simulation_interfaces 2.1.0.
"""

import fcntl
import hashlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path

import numpy
import pytest
import yaml

KILTED = 9
"""First rclpy of ROS 2 Kilted."""
PREFIX = Path(sys.prefix)
DEFINITIONS = Path(__file__).with_name("message_types.yaml")
SHARED = ("rosidl_generator_c", "rosidl_typesupport_c", "rosidl_typesupport_fastrtps_c")
RUNTIME = ("rosidl_runtime_c", "rosidl_typesupport_c", "rosidl_typesupport_fastrtps_c",
           "rosidl_typesupport_fastrtps_cpp", "rcutils", "rmw", "fastcdr")  # fmt: skip
USED = ("action_msgs", "builtin_interfaces", "geometry_msgs", "service_msgs",
        "std_msgs", "trajectory_msgs", "unique_identifier_msgs")  # fmt: skip
"""Packages of the wheels whose types the definitions contain."""


def folder(package):
    """Return the folder of a package.

    It is made once for these definitions and wheels.
    """
    if importlib.util.find_spec("rosidl_generator_py") is None:
        pytest.skip("no generator of message types: part of a ROS installation")
    if int(version("rclpy").partition(".")[0]) < KILTED:
        pytest.skip(
            "not with the rclpy of Jazzy: its middleware asks for introspection"
            " types too"
        )
    if shutil.which("g++") is None:
        pytest.skip("no C++ compiler to make message types with")
    made_of = (
        DEFINITIONS.read_text(),
        Path(__file__).read_text(),
        sys.prefix,
        sys.version,
    )
    key = hashlib.sha256(repr(made_of).encode()).hexdigest()[:16]
    final = Path(tempfile.gettempdir()) / f"sst_ros_{package}_{os.getuid()}_{key}"
    with final.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not final.exists():
            made = tempfile.mkdtemp(prefix=final.name)
            command = [sys.executable, __file__, made, package]
            env = {**os.environ, "AMENT_PREFIX_PATH": sys.prefix}
            made_by = subprocess.run(
                command, env=env, text=True, capture_output=True, check=False
            )
            assert made_by.returncode == 0, made_by.stdout + made_by.stderr
            Path(made).rename(final)
    return final


def make(root, package):
    _generate(root, package, yaml.safe_load(DEFINITIONS.read_text())[package])
    _compile(root, package)


def _generate(root, package, definitions):
    from rosidl_cli.command.translate.api import translate
    from rosidl_generator_c.cli import GenerateC
    from rosidl_generator_py.cli import GeneratePython
    from rosidl_typesupport_c.cli import GenerateCTypesupport
    from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport

    source, out = root / "definitions" / package, root / package
    for name, definition in definitions.items():
        path = source / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(definition["fields"].replace(", ", "\n"))
    shared = {"package_name": package, "include_paths": [str(PREFIX / "share")]}
    files = translate(
        interface_files=[f"{source}:{name}" for name in definitions],
        output_format="idl", output_path=out, **shared,
    )  # fmt: skip
    only = ["rosidl_typesupport_fastrtps_c"]
    for generator in (
        GenerateC("c"),
        GenerateFastRTPSCTypesupport("fastrtps_c"),
        GenerateCTypesupport("c", typesupport_implementations=only),
        GeneratePython("py", typesupport_implementations=["rosidl_typesupport_c"]),
    ):
        generator.generate(
            interface_files=[str(file) for file in files], output_path=out, **shared
        )
    (out / "__init__.py").touch()
    for name, definition in definitions.items():
        description = json.loads((out / name).with_suffix(".json").read_text())
        full = f"{package}/{Path(name).with_suffix('')}"
        hashes = {
            entry["type_name"]: entry["hash_string"]
            for entry in description["type_hashes"]
        }
        assert hashes[full] == definition["hash"], (full, hashes[full])


def _compile(root, package):
    """Compile all into the one extension module that rclpy imports."""
    out = root / package
    alone = sorted(out.rglob("*__description.c"))  # each defines the same static names
    for kind in ("c", "cpp"):
        sources = [path for path in sorted(out.rglob(f"*.{kind}")) if path not in alone]
        one = out / f"one.{kind}"
        one.write_text("".join(f'#include "{path}"\n' for path in sources))
        alone.append(one)
    include = PREFIX / "include"
    folders = [root, sysconfig.get_path("include"), numpy.get_include(), include]
    folders += sorted(path for path in include.iterdir() if path.is_dir())
    flags = ["-fPIC", "-O0", "-w", *(f"-I{path}" for path in folders)]

    def compiled(path):
        compiler = ["g++", "-std=c++17"] if path.suffix == ".cpp" else ["gcc"]
        subprocess.run([*compiler, "-c", *flags, path, "-o", f"{path}.o"], check=True)
        return f"{path}.o"

    with ThreadPoolExecutor(2) as pool:
        objects = list(pool.map(compiled, alone))
    libraries = [
        f"{used}__{kind}" for used in USED for kind in (*SHARED, "rosidl_generator_py")
    ]
    name = f"{package}_s__rosidl_typesupport_c{sysconfig.get_config_var('EXT_SUFFIX')}"
    linked = [f"-l{library}" for library in (*libraries, *RUNTIME)]
    lib = PREFIX / "lib"
    command = [
        "g++",
        "-shared",
        "-o",
        out / name,
        *objects,
        f"-L{lib}",
        f"-Wl,-rpath,{lib}",
    ]
    subprocess.run([*command, *linked], check=True)


if __name__ == "__main__":
    make(Path(sys.argv[1]), sys.argv[2])
