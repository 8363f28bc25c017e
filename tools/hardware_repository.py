# SPDX-License-Identifier: Apache-2.0
"""Make a repository of the package in hardware/.

bloom does not find a package inside another one.

    python -m tools.hardware_repository ../sst_ros_hardware

It has the package at its root, its licence, and one commit with the tag of its version.
In a folder that is such a repository already, the commit of the new version follows the
earlier ones.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "hardware"


def make(folder: Path) -> str:
    """Write the package into a folder and commit it; return the tag.

    Raises:
        SystemExit: the folder has files and is no repository, or has the tag already.

    """
    name = ET.parse(SOURCE / "package.xml").findtext("name")
    version = ET.parse(SOURCE / "package.xml").findtext("version")

    def git(*arguments: str) -> str:
        process = subprocess.run(
            ["git", "-C", folder, *arguments], stdout=subprocess.PIPE, check=True
        )
        return process.stdout.decode()

    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / ".git").exists():
        if any(folder.iterdir()):
            raise SystemExit(
                f"{folder}: must be a new folder or a repository of {name}"
            )
        git("init", "--quiet", "--initial-branch", "main")
    if f"{version}\n" in git("tag"):
        raise SystemExit(f"{folder}: version {version} is there already")
    git("rm", "-r", "--quiet", "--ignore-unmatch", ".")
    shutil.copytree(SOURCE, folder, dirs_exist_ok=True)
    shutil.copy(ROOT / "LICENSE", folder)
    git("add", "--all")
    git("commit", "--quiet", "--message", f"{name} {version}")
    git("tag", str(version))
    return str(version)


def main() -> None:
    """Make the repository in the folder that the command line names."""
    parser = argparse.ArgumentParser(prog="python -m tools.hardware_repository")
    parser.add_argument("folder", type=Path, help="folder of the repository")
    folder = parser.parse_args().folder
    print(f"{folder}: tag {make(folder)}")


if __name__ == "__main__":
    main()
