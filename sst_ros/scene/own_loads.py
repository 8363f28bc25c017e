# SPDX-License-Identifier: Apache-2.0
"""Loads of the user's own, written as formulas in the scene.

A formula is arithmetic on names: no attribute, no index, no call but of a function in
FORMULA_FUNCTIONS. So a scene from a stranger runs no code of its author, and the scene
alone says what acts: in a file, in a bag, on each machine of a cluster.
`dynamics.own_loads.own_load` writes a Python function as formulas.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Iterable
from functools import lru_cache

from sst_ros.scene.loads import JOINTS
from sst_ros.scene.schema import Rules, Section, choice, entry

ROTATION = tuple(f"R{i}{j}" for i in "123" for j in "123")
"""Entries of R, the orientation of {E} in {B}: R13, R23, R33 is the direction of E."""

ANGLE_NAMES = JOINTS
# angular velocity of the star in {B} [rad/s]
OMEGA = tuple(f"omega_{axis}" for axis in "xyz")
BODY_RATE = tuple(f"body_rate_{axis}" for axis in "xyz")  # the same in {E}
RATE_NAMES = tuple(name.replace("_", "_dot_") for name in ANGLE_NAMES)

POSE_NAMES = (*ROTATION, *ANGLE_NAMES)
"""Names that a potential may use."""
STATE_NAMES = (*POSE_NAMES, *OMEGA, *BODY_RATE, *RATE_NAMES)
"""Names that a moment may use."""

FORMULA_FUNCTIONS = {
    "sqrt": 1, "exp": 1, "sin": 1, "cos": 1, "tan": 1, "tanh": 1, "abs": 1,
    "positive": 1, "atan2": 2, "min": 2, "max": 2,
}  # fmt: skip
"""Number of arguments of each function.

positive(x) is x where x > 0 and zero elsewhere.
"""

RESERVED = {"pi", *STATE_NAMES, *FORMULA_FUNCTIONS}
LONGEST_FORMULA = 4000  # characters of a formula: the parser of Python recurses
# numbers, names and operations of a load: more is no formula, but a program
MOST_FORMULA_PARTS = 4000
DEEPEST_FORMULA = 200  # levels of a formula, whose evaluation recurses
LARGEST_POWER = 8  # a power is written as products
FORMULA_OPERATORS = (ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow)
SIGNS = (ast.USub, ast.UAdd)

_NAME_PATTERN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


class LoadParameter(Section):
    """A number of an own load, which sweeps, sensitivities and proofs may vary."""

    name: str = entry("its name in the formulas")
    value: float = entry("its value, in SI units", "SI")

    def rules(self) -> Rules:
        """Refuse names that formulas cannot have, or that mean something else."""
        yield _is_strange(self.name), "name", self.name, _describe_name()


class FormulaLoad(Section):
    """A load by its potential energy, or by its moment on the star.

    A potential acts where its formula says: by the rotation R on the star, by an angle
    at that joint. Formulas have + - * / **, whole powers up to 8, sqrt, exp, sin, cos,
    tan, tanh, atan2, abs, min, max, positive and pi. Their names are the parameters,
    the terms, and of the state R11 to R33 (rows and columns of the rotation of {E} in
    {B}), gamma_1 to beta_3 [rad], and for a moment omega_x (of the star in {B}),
    body_rate_x (in {E}) and gamma_dot_1 to beta_dot_3 [rad/s].
    """

    ONE_OF = "potential", "moment"

    name: str = entry("short name")
    parameters: tuple[LoadParameter, ...] = entry("numbers with names", default=())
    terms: tuple[tuple[str, str], ...] = entry(
        "intermediate results by name, each of those before it", default=()
    )
    potential: str | None = entry("formula of the potential energy [J]")
    moment: tuple[str, ...] = entry(
        "three formulas of the moment on the star [N m]", default=()
    )
    frame: str = choice("axes of the moment: those of {B} or of {E}", ("base", "star"))

    @property
    def texts(self) -> dict[str, str]:
        """Every formula of the load by its key."""
        own = {f"terms.{name}": text for name, text in self.terms}
        if self.potential is not None:
            own["potential"] = self.potential
        return own | {f"moment[{i}]": text for i, text in enumerate(self.moment)}

    def rules(self) -> Rules:
        """Refuse what is no formula, and names that are not there."""
        count = len(self.moment)
        yield count not in (0, 3), "moment", self.moment, "must be three formulas"
        usable_names = set(STATE_NAMES if self.moment else POSE_NAMES)
        for parameter in self.parameters:
            repeated = parameter.name in usable_names
            yield repeated, "parameters", parameter.name, "is given twice"
            usable_names.add(parameter.name)
        size = 0
        for key, text in self.texts.items():
            fault = find_fault(text, frozenset(usable_names))
            yield bool(fault), key, text, fault
            if not fault:
                size += sum(1 for _ in ast.walk(parse(text)))
            name = key.removeprefix("terms.")
            if name != key:  # the formula of a term
                strange = _is_strange(name) or name in usable_names
                yield strange, key, name, f"{_describe_name()}, and given once"
                usable_names.add(name)
        requirement = f"must have at most {MOST_FORMULA_PARTS} parts"
        yield size > MOST_FORMULA_PARTS, "", size, requirement


@lru_cache(maxsize=256)
def parse(text: str) -> ast.expr:
    """Parse a formula; raises ValueError where it is none."""
    if len(text) > LONGEST_FORMULA:
        raise ValueError(f"must have at most {LONGEST_FORMULA} characters")
    try:
        return ast.parse(text, mode="eval").body
    except (SyntaxError, RecursionError, MemoryError):
        raise ValueError("must be a formula, as 0.5 * k * gamma_1**2 is one") from None


@lru_cache(maxsize=256)
def find_fault(text: str, usable_names: frozenset[str]) -> str:
    """Say what a formula must be that a text is not; "" where it is a formula.

    Its names must be among `usable_names`.
    """
    try:
        tree = parse(text)
    except ValueError as error:
        return str(error)
    if _measure_depth(tree) > DEEPEST_FORMULA:
        return f"must have at most {DEEPEST_FORMULA} levels: write parts of it as terms"
    nodes = list(ast.walk(tree))
    function_names = {id(node.func) for node in nodes if isinstance(node, ast.Call)}
    for node in nodes:
        if id(node) in function_names:
            continue
        fault = _fault_of(node, usable_names)
        if fault:
            return fault
    return ""


def _measure_depth(tree: ast.AST) -> int:
    """Count the levels of a formula."""
    depth = 0
    level = [tree]
    while level:
        depth += 1
        level = [child for node in level for child in ast.iter_child_nodes(node)]
    return depth


def _fault_of(node: ast.AST, usable_names: frozenset[str]) -> str:
    """Say what is wrong with one part of a formula; "" for nothing."""
    if isinstance(node, (*FORMULA_OPERATORS, *SIGNS, ast.Load)):
        return ""
    if isinstance(node, ast.BinOp) and isinstance(node.op, FORMULA_OPERATORS):
        return _fault_of_operation(node)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, SIGNS):
        return ""
    if isinstance(node, ast.Constant):
        return "" if is_finite(node.value) else "must have finite numbers only"
    if isinstance(node, ast.Name):
        return _fault_of_name(node.id, usable_names)
    if isinstance(node, ast.Call):
        return _fault_of_call(node)
    return f"must be arithmetic: {type(node).__name__} is not allowed"


def _fault_of_name(name: str, usable_names: frozenset[str]) -> str:
    if name in usable_names or name == "pi":
        return ""
    if name in STATE_NAMES:
        return f"must be of the pose alone: {name} is a rate"
    if name in FORMULA_FUNCTIONS:
        return f"must give {name} its arguments in brackets"
    return f"must have known names only: {name} is neither state, parameter nor term"


def _fault_of_operation(node: ast.BinOp) -> str:
    if isinstance(node.op, ast.Div):
        divisor = node.right
        if isinstance(divisor, ast.Constant) and divisor.value == 0:
            return "must not divide by zero"
    if isinstance(node.op, ast.Pow) and power_of(node) is None:
        return f"must have powers that are whole numbers up to {LARGEST_POWER}"
    return ""


def _fault_of_call(node: ast.Call) -> str:
    name = node.func.id if isinstance(node.func, ast.Name) else ""
    if name not in FORMULA_FUNCTIONS:
        return f"must call one of {', '.join(FORMULA_FUNCTIONS)}"
    count = FORMULA_FUNCTIONS[name]
    starred = any(isinstance(argument, ast.Starred) for argument in node.args)
    if node.keywords or starred or len(node.args) != count:
        return f"must give {name} {count} argument{'s' if count > 1 else ''}"
    return ""


def is_finite(value: object) -> bool:
    """Whether a constant is a number that has a finite double.

    Text and True are none.
    """
    if type(value) is not int and type(value) is not float:
        return False
    try:
        return math.isfinite(float(value))
    except OverflowError:
        return False


def power_of(node: ast.BinOp) -> int | None:
    """Return the power that a part of a formula raises to.

    None where it is not allowed.
    """
    exponent = node.right
    sign = 1
    if isinstance(exponent, ast.UnaryOp) and isinstance(exponent.op, ast.USub):
        exponent = exponent.operand
        sign = -1
    if not isinstance(exponent, ast.Constant) or type(exponent.value) is not int:
        return None
    if not 1 <= exponent.value <= LARGEST_POWER:
        return None
    return sign * exponent.value


def names_in(texts: Iterable[str]) -> set[str]:
    """Return the names that formulas use, those of functions left out."""
    names = set()
    for text in texts:
        for node in ast.walk(parse(text)):
            if isinstance(node, ast.Name):
                names.add(node.id)
    return names - FORMULA_FUNCTIONS.keys()


def _is_strange(name: str) -> bool:
    return name in RESERVED or not _NAME_PATTERN.fullmatch(name)


def _describe_name() -> str:
    return "must be a name of letters, digits and _ that means nothing else"
