# SPDX-License-Identifier: Apache-2.0
"""What a release consists of: version, extras, package.xml, changelogs, wheel, source
archive.
"""

import os
import re
import runpy
import shutil
import subprocess
import sys
import venv
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import yaml
from colcon_choice import ON_A_PLATFORM

import sst_ros
from sst_ros.cli.commands import NODE_HELP
from sst_ros.errors import EXTRAS
from tools import changelog_rst, metadata, rosdep_keys

ROOT = Path(__file__).parents[1]

MARKDOWN = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
RST = (ROOT / "CHANGELOG.rst").read_text(encoding="utf-8")
_SAME = "argcomplete hypothesis jinja2 jsonschema matplotlib numpy pandas pytest scipy"
PYTHON_KEYS = {
    name: f"python3-{name}" for name in (*_SAME.split(), "pytest-timeout")
} | {
    "llvmlite": "python3-numba",  # which needs llvmlite, that has no key
    "mpmath": "python3-sympy",  # which needs mpmath
    "PyYAML": "python3-yaml",
}
"""Keys of rosdep, which are packages of apt as bloom needs them: it refuses keys of
pip.
"""

WITHOUT_KEY = {
    "control",
    "dask",
    "mcap",
    "pyarrow",
    "python-flint",
    "rosbags",
    "viser",
    "xarray",
}
"""Python packages of setup.py that have none, or one of pip: `pip install
sst_ros[all]`.
"""

KEYS = yaml.safe_load((ROOT / "test/rosdep_keys.yaml").read_text(encoding="utf-8"))
"""What each key is in each distribution, on a date: python -m tools.rosdep_keys."""

RELEASED_FOR = ("debian", "ubuntu")
"""Systems for which bloom makes packages.

docs/release.md says why RHEL and Fedora are left out.
"""

BRINGS = {
    "distributed": "dask[distributed]",
    "flint": "python-flint>=",
    "lz4": "rosbags",
    "pinocchio": "pin>=",
    "trimesh": "viser",
    "websockets": "viser",
    "zstandard": "rosbags",
}
"""Package that brings a module of another name."""


def test_version_and_metadata_are_those_of_package_xml():
    texts = {
        name: (ROOT / name).read_text(encoding="utf-8") for name in metadata.written()
    }
    assert texts == metadata.written(), "run python -m tools.metadata"
    assert sst_ros.__version__ == metadata.version()
    assert f'VERSION = "{metadata.version()}"' in texts["sst_ros/version.py"]


def test_what_a_person_fills_in_is_in_one_file():
    """Addresses that exist nowhere stand in package.xml and its copy, nothing else."""
    assert len(metadata.placeholders()) == 3
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True
    )
    if listed.returncode:
        pytest.skip("needs a clone by git")
    files = {ROOT / name for name in listed.stdout.splitlines()} - {Path(__file__)}
    texts = {
        path: path.read_text(encoding="utf-8", errors="ignore")
        for path in files
        if path.is_file() and path.stat().st_size < 200_000
    }
    marked = [path for path, text in texts.items() if "sst-ros.invalid" in text]
    found = {path.relative_to(ROOT).as_posix() for path in marked}
    assert found == {"package.xml", "hardware/package.xml"}
    assert not [path for path, text in texts.items() if "@example.org" in text]


def test_every_extra_that_a_message_names_brings_the_module():
    setup = (ROOT / "setup.py").read_text()
    for module, extra in EXTRAS.items():
        assert f'"{extra}"' in setup
        package = BRINGS.get(module, module)
        assert f'"{package}' in setup


def test_every_node_has_an_executable_for_ros2_run():
    assert {path.name for path in (ROOT / "executables").iterdir()} == set(NODE_HELP)
    assert all(os.access(ROOT / "executables" / name, os.X_OK) for name in NODE_HELP)


def test_colcon_runs_files_that_exist():
    """A name that is wrong would end `colcon test` before its first test."""
    missing = [name for name in ON_A_PLATFORM if not (ROOT / "test" / name).exists()]
    assert not missing
    assert len(ON_A_PLATFORM) == len(set(ON_A_PLATFORM))


def test_colcon_measures_no_coverage(setup_arguments):
    """It does where the extra `test` names pytest-cov, which ROS's tools bring."""
    extras = setup_arguments["extras_require"]
    assert not [word for word in extras["test"] if word.startswith("pytest-cov")]


@pytest.fixture(scope="module")
def depends():
    root = ET.parse(ROOT / "package.xml").getroot()
    return {found.text for found in root if found.tag.endswith("depend")}


@pytest.fixture(scope="module")
def setup_arguments():
    """What setup.py gives to setuptools."""
    given = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        patch.setattr("setuptools.setup", given.update)
        runpy.run_path("setup.py")
    return given


@pytest.fixture(scope="module")
def required(setup_arguments):
    """Names of Python packages that setup.py asks for, without the wheels of ROS."""
    extras = setup_arguments["extras_require"]
    words = [*setup_arguments["install_requires"], *extras["all"]]
    names = {re.match(r"[\w-]+", word)[0] for word in words}
    return {name for name in names if not name.startswith("ros-")}


def test_the_stored_table_has_the_keys_of_today():
    assert rosdep_keys.keys() == list(KEYS["keys"]), "run python -m tools.rosdep_keys"
    assert list(KEYS["platforms"]) == ["jazzy", "kilted", "lyrical"]


@pytest.mark.parametrize("distribution", KEYS["platforms"])
def test_every_key_resolves_on_every_platform(distribution):
    """A package of ROS released there, or a package of the system: none of pip."""
    platforms = {
        f"{system} {release}"
        for system, releases in KEYS["platforms"][distribution].items()
        for release in releases
        if system in RELEASED_FOR
    }
    assert len(platforms) == 2
    for key, known in KEYS["keys"].items():
        told = known[distribution]
        assert isinstance(told, str) or platforms <= set(told), key


def test_platforms_without_all_keys_are_named():
    """docs/release.md names each key that RHEL or Fedora has no package for."""
    missing = set()
    for distribution, platforms in KEYS["platforms"].items():
        others = {
            f"{system} {release}"
            for system, releases in platforms.items()
            for release in releases
            if system not in RELEASED_FOR
        }
        for key, known in KEYS["keys"].items():
            told = known[distribution]
            if not isinstance(told, str) and others - set(told):
                missing.add(key)
    page = (ROOT / "docs/release.md").read_text(encoding="utf-8")
    assert missing and not [key for key in missing if key not in page]


@pytest.mark.parametrize("desktop", ["", "1"])
def test_what_needs_a_screen_is_asked_for_only_with_a_desktop(desktop):
    parse = pytest.importorskip("catkin_pkg.package").parse_package
    package = parse(ROOT)
    package.evaluate_conditions({"ROS_DISTRO": "kilted", "SST_ROS_DESKTOP": desktop})
    asked = {one.name for one in package.exec_depends if one.evaluated_condition}
    heavy = {"rviz2", "ros2bag", "rosbag2_storage_mcap", "robot_state_publisher"}
    assert asked & heavy == (heavy if desktop else set())
    assert "rclpy" in asked


def test_every_requirement_has_its_key(depends, required):
    assert required <= PYTHON_KEYS.keys() | WITHOUT_KEY
    missing = {PYTHON_KEYS[name] for name in required - WITHOUT_KEY} - depends
    assert not missing


def test_every_message_package_of_the_wheels_is_named(depends):
    text = (ROOT / "setup.py").read_text(encoding="utf-8")
    listed = text.partition("ROS_MESSAGES = (")[2].partition(")")[0]
    kinds = re.findall(r'"(\w+)"', listed)
    assert {f"{kind}_msgs" for kind in kinds} <= depends


def test_the_changelogs_agree():
    assert changelog_rst.text(MARKDOWN) == RST, "run python -m tools.changelog_rst"
    assert "Unreleased" in MARKDOWN and "Unreleased" not in RST


def test_the_parser_of_bloom_reads_every_release():
    changelog = pytest.importorskip("catkin_pkg.changelog").get_changelog_from_path(
        ROOT, "sst_ros"
    )
    read = {
        version: (date, content)
        for version, date, content in changelog.foreach_version()
    }
    assert list(read)[::-1] == re.findall(r"^## \[(\d\S+)\] - ", MARKDOWN, re.M)
    assert sst_ros.__version__ in read
    total = 0
    for version, (date, content) in read.items():
        head = f"## [{version}] - {date.date()}"
        released = MARKDOWN.partition(head)[2].partition("\n## ")[0]
        bullets = [one.bullets for one in content if hasattr(one, "bullets")]
        items = sum(map(len, bullets))
        assert items == len(re.findall(r"^- ", released, re.M))
        total += items
    assert total > 10  # the section of a release that is tried may be empty


@pytest.mark.slow
def test_the_changelog_is_restructured_text():
    core = pytest.importorskip("docutils.core")
    core.publish_doctree(RST, settings_overrides={"report_level": 1, "halt_level": 1})


def test_package_xml_is_valid():
    package = pytest.importorskip("catkin_pkg.package")
    warnings = []
    parsed = package.parse_package(ROOT, warnings=warnings)
    parsed.validate(warnings)
    assert warnings == []
    assert (parsed.version, parsed.get_build_type()) == (
        sst_ros.__version__,
        "ament_python",
    )


def data_of(package):
    """Return the files of a package that are no code: templates, profiles, the mark of
    types.
    """
    files = (path for path in package.rglob("*") if path.is_file())
    return {
        path.relative_to(package)
        for path in files
        if path.suffix not in (".py", ".pyc")
    }


def check_installed(python, folder):
    """Try what an installation without any extra offers, from a folder that is not the
    source.
    """
    environment = {
        **os.environ,
        "PATH": f"{python.parent}{os.pathsep}{os.environ['PATH']}",
    }
    environment.pop("PYTHONPATH", None)

    def run(*words):
        pipes = {"capture_output": True, "text": True, "timeout": 120}
        return subprocess.run(words, cwd=folder, env=environment, **pipes)

    command = python.parent / "sst-ros"
    assert not {path.name for path in python.parent.iterdir()} & {*NODE_HELP}
    assert run(command, "--version").stdout == f"sst-ros {sst_ros.__version__}\n"
    assert "example2" in run(command, "scene", "list").stdout
    done = run(
        command, "simulate", "example2", "--duration", "0.01", "--method", "dopri5"
    )
    assert done.returncode == 0, done.stderr
    assert "reached the end" in done.stdout
    nodes = python.parents[1] / "lib" / "sst_ros"
    for words in (
        [command, "plot", "bag"],
        [command, "demo"],
        *([nodes / name] for name in NODE_HELP),
    ):
        done = run(*words)
        assert done.returncode == 1, words
        assert re.fullmatch(r"sst-ros: \w+ is not installed: .*\n", done.stderr), (
            done.stderr
        )
    where = run(python, "-c", "import sst_ros; print(*sst_ros.__path__)")
    installed = Path(where.stdout.strip())
    assert installed.is_relative_to(python.parents[1]), where.stderr
    assert data_of(installed) == data_of(ROOT / "sst_ros") > {Path("py.typed")}


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_an_installation_without_extras_works(tmp_path):
    """Of the wheel that is built from the source distribution."""
    for needed in ("build", "twine"):
        pytest.importorskip(needed, reason=f"needs {needed}: pip install .[test]")
    source = tmp_path / "source"
    ignored = shutil.ignore_patterns(
        ".*", "*_out", "__pycache__", "*.egg-info", "build", "site"
    )
    shutil.copytree(ROOT, source, ignore=ignored)
    build = [sys.executable, "-m", "build", "--outdir", tmp_path / "dist", source]
    subprocess.run(build, check=True, capture_output=True, timeout=300)
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    (archive,) = (tmp_path / "dist").glob("*.tar.gz")
    # the description renders
    check = [sys.executable, "-m", "twine", "check", "--strict", wheel, archive]
    checked = subprocess.run(check, capture_output=True, text=True)
    assert checked.returncode == 0, checked.stdout + checked.stderr
    venv.create(tmp_path / "fresh", with_pip=True)
    python = tmp_path / "fresh" / "bin" / "python"
    install = [
        python,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--disable-pip-version-check",
        wheel,
    ]
    subprocess.run(install, check=True, timeout=300)
    check_installed(python, tmp_path)
