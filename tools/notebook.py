# SPDX-License-Identifier: Apache-2.0
"""Run the notebook of the tutorial and store its outputs: python -m tools.notebook."""

from pathlib import Path

NOTEBOOK = Path(__file__).parents[1] / "docs" / "tutorial" / "first_steps.ipynb"


def main() -> None:
    """Execute every cell in a fresh kernel; needs the extra `docs`."""
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(notebook, timeout=120, record_timing=False).execute()
    nbformat.write(notebook, NOTEBOOK)


if __name__ == "__main__":
    main()
