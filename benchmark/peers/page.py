# SPDX-License-Identifier: Apache-2.0
"""docs/peers.md, written by the command that measured it."""

from __future__ import annotations

from pathlib import Path

from pandas import DataFrame

from benchmark import machine
from benchmark.peers import results as tables
from benchmark.peers.results import Results
from benchmark.peers.study import TARGETS
from sst_ros.report.results import markdown

TEXT = """\
# Speed and accuracy compared with MuJoCo, Pinocchio, Drake, Exudyn and SciPy

<!-- Written by `python -m benchmark.peers`. -->

{date}. One second of Example 2 of the paper (scene `example2_heavy`: its star is 1.25 times
as heavy; three sine torques, from rest) on every engine, with the same seven links. The error is
the angle between the star's orientation at t = 1 s and the reference; the time is that of the whole
second, in seconds of the processor.

![Error against processor time](peers.png)

## Time to reach an error

Time in ms, and how many times ours that is. The time is that of the fastest setting tried
whose error is as small or smaller, not interpolated. Ours is a call of `sst_ros.simulate`, its
checks and the `Trajectory` that it returns included. "-": not reached by any setting;
the steps end at 16000 a second for MuJoCo (3200 with Python torques, 6400 for rollout), at 20000
for Drake and at 8000 for Exudyn.

{best}

{verdicts}

## Lower bound of the cost

A method that evaluates the acceleration, and not its derivatives, needs at least as many
evaluations as a polynomial through them, at the Gauss nodes of the true motion, needs to give the
orientation at the end to the error. The table has their time in C, one after the other on one core,
and the ratio of each engine to it:

{floor}

No method that evaluates one acceleration at a time can be faster. The collocation of sst_ros
evaluates eight or twelve at once, by SIMD, and iterates.

## By method

"Python runs" names what the Python interpreter does while the clock runs. "Gate" is the relative
difference of gamma_ddot to the paper's equations at three moving states; an engine that fails it
is not timed.

{series}

{missing}{settings}

## Notes and limits

- **Not the same kind of program.** MuJoCo, Pinocchio, Drake and Exudyn simulate any mechanism,
  with contacts, limits and much else; sst_ros simulates this one, in three coordinates that close
  its loops by construction. The ratios measure what such a formulation gains here. They do not mean
  that those engines are slow: each does more work per step than this mechanism needs.
- **Where Python is.** sst_ros compiled by numba, Drake, Exudyn and MuJoCo with compiled torques
  have nothing of Python in their loop. Pinocchio is driven from Python, with preallocated arrays
  and one product a stage; about a third of its time is then the interpreter's, which a loop in C++
  would save, but that is a program to write. SciPy and NumPy are Python all through. "DOP853,
  plain Python" is sst_ros without any compiler.
- **The method counts.** A method of order 8 needs far fewer evaluations at 1e-9 rad than RK4 does,
  on any engine. Where an engine leaves the integrator to its user (Pinocchio) it gets our DOP853
  too, in Python; RK4 is what its users write, so both are listed. sst_ros has collocation besides,
  whose SIMD needs a right-hand side that is one straight line of operations;
  MuJoCo, Drake and Exudyn have no method of order above 4 for mechanisms with loops. Compare equal
  methods by the rows above.
- **MuJoCo's best setting takes work.** The torques are evaluated by a compiled callback at the
  exact times of all stages, and solref, the softness of the ties (through the mobility that MuJoCo
  derives from masses and centres of mass) and the step are swept together. With one setting for
  all errors, or with torques held over a step, it is slower: see its other rows. Its ties are soft
  by design.
- **Pinocchio's** loop closure is integrated without stabilisation: over one second the drift stays
  below the errors shown; over long runs it would need some.
- **Drake** closes loops only in its discrete solver, which holds torques over a step and is of
  order 1: it is made for contact, not for this. **Exudyn** integrates redundant coordinates with
  methods of order 2.
- **SciPy** is on the paper's matrix equations in NumPy as they are written, 3 x 3 at a time: the
  direct translation, not what SciPy can do with a compiled right-hand side. With the state
  (γ, γ̇) it solves the direct kinematics for all eight assembly modes at every evaluation, as in
  the paper; with (q, γ̇) this is not needed.
- **Prepared before the clock starts.** Every engine has its data ready, and its clock begins at
  the start: MuJoCo's `mjData`, Pinocchio's arrays and views, the prepared motion that `simulate`
  remembers. Torques are evaluated while the clock runs, on all engines but for MuJoCo's rollout.
- **Rounding.** Collocation alone is compiled with fused multiply-adds and shared reciprocals, so
  its last digits are not those of plain Python. Its sines are arithmetic (`integration.sines`):
  a call of the library would end SIMD.
- **Not in the times:** compiling (numba, first call: some seconds, then from a cache), building
  models, and turning the end state into an orientation.
- **The machine** was not idle, so times are of the processor (of all threads of the process), not
  of the wall. They are medians of {rounds} rounds in which every setting takes its turn; ratios are
  medians of the quotients of each round. Trust ratios.
- **The reference** is an extrapolation method in 32-digit arithmetic (mpmath); two step sizes are
  {reference} rad apart. It is kept as doubles, 2e-16. It integrates the traced program of sst_ros,
  which the gates hold against the paper's equations and against the other engines.

{count} settings were run for their error. Those that no setting with as few steps beats were
timed; these and those that failed are in [peers.csv](peers.csv), [peers.json](peers.json).

{machine}. {quick}The whole took {seconds:.0f} s.
"""


def write(results: Results, path: Path) -> None:
    """Write the page."""
    missing = "".join(f"{name}: {why}.\n\n" for name, why in results.missing.items())
    text = TEXT.format(
        date=results.machine["date"],
        best=_markdown(tables.best_rows(results)),
        verdicts="\n".join(f"- {line}." for line in tables.verdicts(results)),
        series=_markdown(tables.rows(results)),
        floor=_markdown(tables.floor_rows(results)),
        missing=missing,
        settings=_settings(results),
        rounds=results.rounds,
        count=sum(len(curve.points) for curve in results.curves),
        reference=f"{results.reference_error:.0e}",
        machine=machine.line(results.machine),
        quick="A quick, smaller sweep. " if results.quick else "",
        seconds=results.seconds,
    )
    path.write_text(text, encoding="utf-8")


def _settings(results: Results) -> str:
    """The setting behind each best time."""
    lines = ["The settings behind the best times:", ""]
    for engine in results.engines:
        parts = []
        for target in TARGETS:
            point = results.best(engine, target).point
            if point is not None:
                method = next(c.series.name for c in results.curves if point in c.points)
                parts.append(f"{target:.0e} rad: {method}, {point.setting.label}")
        lines.append(f"- {engine}: {'; '.join(parts) or 'none'}.")
    return "\n".join(lines)


def _markdown(cells: list[list[str]]) -> str:
    return markdown(DataFrame(cells[1:], columns=cells[0]))
