# SPDX-License-Identifier: Apache-2.0
"""`plot`: pictures of a recorded run, or of several."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.cli.parsing import Commands, add_out
from sst_ros.output_folder import require_free, results_folder


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    plot = commands.add_parser("plot", help="draw recorded runs, as PDF and PNG")
    plot.add_argument("bags", type=Path, nargs="*", metavar="BAG", help="folder of the bag")
    add_out(plot, "folder of the pictures", "BAG_plots, beside the first bag")
    plot.add_argument("--only", nargs="+", default=[], metavar="NAME", help="draw only these")
    plot.add_argument("--list", action="store_true", help="list the pictures, and draw none")
    plot.add_argument(
        "--compare", nargs="+", type=Path, default=[], metavar="BAG",
        help="overlay runs and print their differences from the first",
    )  # fmt: skip
    plot.set_defaults(run=_plot, parser=plot)


def _plot(options: argparse.Namespace) -> int:
    if options.list:
        from sst_ros.plot import compare, pictures

        for name, picture in pictures.PICTURES.items():
            print(f"{name:<18}{picture.title}; needs {', '.join(picture.needs)}")
        print(f"{'with --compare':<18}{', '.join(compare.PICTURES)}")
        return 0
    bags = [*options.bags, *options.compare]
    if not bags or (len(bags) > 1 and not options.compare):
        options.parser.error("name one BAG, or several with --compare")
    out = options.out or results_folder(bags[0], "plots")
    require_free(out, "plot", force=options.force)
    from sst_ros.plot import compare, pictures
    from sst_ros.recording import signals

    runs = [signals.read(bag) for bag in bags]
    if options.compare:
        print(compare.table(runs))
        paths, missing = compare.draw(runs, out, options.only)
    else:
        paths, missing = pictures.draw(runs[0], out, options.only)
    for path in paths:
        print(path)
    for name, why in missing.items():
        print(f"{name}: {why}")
    return 0 if paths else 1
