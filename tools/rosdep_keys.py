# SPDX-License-Identifier: Apache-2.0
"""Write test/rosdep_keys.yaml: each key of package.xml by a copy of ros/rosdistro.

    git clone https://github.com/ros/rosdistro
    python -m tools.rosdep_keys rosdistro

A key is a package that a distribution of ROS releases, or the system's package of that
name.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[1]
TABLE = ROOT / "test" / "rosdep_keys.yaml"
PACKAGES = (ROOT / "package.xml", ROOT / "hardware" / "package.xml")
DISTRIBUTIONS = ("jazzy", "kilted", "lyrical")
RULES = ("base", "python")
HEAD = """\
# SPDX-License-Identifier: Apache-2.0
# Written by `python -m tools.rosdep_keys`: each key of package.xml and \
hardware/package.xml, by
# distribution its version there, or the platforms on which the system has a \
package for it.
"""


def keys() -> list[str]:
    """List the keys of all packages of this repository, each once."""
    texts = [path.read_text(encoding="utf-8") for path in PACKAGES]
    found = {
        key for text in texts for key in re.findall(r"_?depend[^>]*>([\w-]+)</", text)
    }
    return sorted(found)


def has_package(rule: Any, release: str) -> bool:
    """Tell whether a rule of rosdep names a package of the system, not one of pip."""
    if isinstance(rule, dict) and ("*" in rule or release in rule):
        rule = rule.get(release, rule.get("*"))
    if isinstance(rule, dict):
        rule = rule.get("packages") if "pip" not in rule else None
    return bool(rule)


def platforms_of(rules: Any, platforms: dict[str, list[str]]) -> Iterator[str]:
    """Name the platforms of a distribution that have a package for a key."""
    for system, releases in platforms.items():
        for release in releases:
            if has_package(rules.get(system), release):
                yield f"{system} {release}"


def table(folder: Path) -> dict[str, Any]:
    """Read what each key is from a copy of ros/rosdistro."""

    def git(*arguments: str) -> str:
        process = subprocess.run(
            ["git", "-C", folder, *arguments], stdout=subprocess.PIPE, check=True
        )
        return process.stdout.decode()

    def document(path: str) -> Any:
        return yaml.load(git("show", f"HEAD:{path}"), yaml.CSafeLoader)

    commit, date = git("log", "-1", "--format=%H %cs").split()
    rules: dict[str, Any] = {}
    for name in RULES:
        rules |= document(f"rosdep/{name}.yaml")
    found: dict[str, Any] = {key: {} for key in keys()}
    platforms = {}
    for distribution in DISTRIBUTIONS:
        listed = document(f"{distribution}/distribution.yaml")
        platforms[distribution] = listed["release_platforms"]
        released = {}
        for name, repository in listed["repositories"].items():
            release = repository.get("release", {})
            for package in release.get("packages", [name]):
                released[package] = release.get("version")
        for key, released_keys in found.items():
            if released.get(key):
                released_keys[distribution] = released[key]
            elif key in rules:
                released_keys[distribution] = [
                    *platforms_of(rules[key], platforms[distribution])
                ]
    return {"commit": commit, "date": date, "platforms": platforms, "keys": found}


def main() -> None:
    """Write the table from the copy that the command line names."""
    text = yaml.safe_dump(table(Path(sys.argv[1])), sort_keys=False, width=100)
    TABLE.write_text(HEAD + text, encoding="utf-8")


if __name__ == "__main__":
    main()
