# SPDX-License-Identifier: Apache-2.0
"""Exact derivatives of traced functions, as programs (forward mode)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sst_ros.dynamics.expression import Expression, Graph, Program, Value, program_of


def with_jacobian(
    function: Callable[..., Sequence[Value]], inputs: Sequence[str], by: Sequence[str]
) -> Program:
    """Trace `function` and its exact derivatives; outputs are f, then df/dx for each x in `by`."""
    graph = Graph()
    symbols = [graph.node("input", name) for name in inputs]
    outputs = tuple(function(*symbols))
    last = len(graph.nodes)
    everything = list(outputs)
    for name in by:
        slopes = _slopes(graph, last, symbols[list(inputs).index(name)])
        everything += [slopes[out.index] if isinstance(out, Expression) else 0.0 for out in outputs]
    return program_of(graph, tuple(inputs), tuple(everything))


def _slopes(graph: Graph, last: int, by: Expression) -> list[Value]:
    """Differentiate each of the first `last` nodes by one input (forward mode)."""
    slopes: list[Value] = []
    for index in range(last):
        op, args = graph.nodes[index]
        here = Expression(graph, index)
        d = [slopes[a.index] if isinstance(a, Expression) else 0.0 for a in args]
        slopes.append(float(index == by.index) if op == "input" else _chain(op, args, d, here))
    return slopes


def _chain(op: str, args: tuple[Value, ...], d: list[Value], here: Expression) -> Value:
    x = args[0]
    if op in ("add", "sub"):
        return d[0] + d[1] if op == "add" else d[0] - d[1]
    if op == "mul":
        return d[0] * args[1] + x * d[1]
    if op == "div":
        return (d[0] - here * d[1]) / args[1]
    if op == "atan2":
        return (d[0] * args[1] - x * d[1]) / (x * x + args[1] * args[1])
    inner: dict[str, Callable[[], Value]] = {
        "neg": lambda: -1.0,
        "sqrt": lambda: 0.5 / here,
        "tanh": lambda: 1.0 - here * here,
        "exp": lambda: here,
        "sin": lambda: x.traced("cos"),
        "cos": lambda: -x.traced("sin"),
        "positive": lambda: x.traced("step"),
        "step": lambda: 0.0,
    }
    return 0.0 if not isinstance(d[0], Expression) and d[0] == 0.0 else inner[op]() * d[0]
