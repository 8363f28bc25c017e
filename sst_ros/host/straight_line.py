# SPDX-License-Identifier: Apache-2.0
"""Straight-line functions of floats as instructions of LLVM, for numba's compiled code to call.

numba finds the type of each operation before it compiles it, which takes a millisecond; traced
functions have hundreds of operations, all of floats. Their text, the same as for the interpreter,
becomes one instruction an operation here, in the same order.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping, Sequence
from inspect import Parameter, Signature
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.typing import signature
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

_FLOAT, _INT = ir.DoubleType(), ir.IntType(64)
_POSITIONAL = Parameter.POSITIONAL_OR_KEYWORD
_OPERATIONS = {ast.Add: "add", ast.Sub: "sub", ast.Mult: "mul", ast.Div: "div"}


def straight_line(text: str, names: Mapping[str, Any]) -> Any:
    """Return what compiled code calls in place of a function with this text.

    Its arguments are floats and arrays of floats. It assigns names and elements of arrays, also in
    loops of a fixed count in which no turn needs what another has assigned, and returns a tuple of
    floats or nothing. It may call functions of math, abs, max of two, and other functions that are
    made here, by their names in the module, which are `names`.
    """
    function: Any = ast.parse(text).body[0]
    count = len(_results(function))

    def call(_: Any, *given: Any) -> Any:
        returned = types.UniTuple(types.float64, count) if count else types.none

        def generate(context: Any, builder: Any, made: Any, values: Sequence[Any]) -> Any:
            numbers = [
                make_array(kind)(context, builder, value).data
                if isinstance(kind, types.Array)
                else context.cast(builder, value, kind, types.float64)
                for kind, value in zip(given, values, strict=True)
            ]
            found = _call(function, names, context, builder, numbers)
            return context.make_tuple(builder, made.return_type, found) if count else found

        return signature(returned, *given), generate

    # numba takes the names of the arguments from here.
    described: Any = call
    parameters = ["context", *(argument.arg for argument in function.args.args)]
    described.__signature__ = Signature([Parameter(name, _POSITIONAL) for name in parameters])
    described.__name__ = function.name
    made: Any = intrinsic(described)
    made.function = function
    return made


def _results(function: Any) -> list[Any]:
    match function.body[-1]:
        case ast.Return(value=ast.Tuple(elts=results)):
            return results
    return []


def _call(
    function: Any, names: Mapping[str, Any], context: Any, builder: Any, numbers: Sequence[Any]
) -> Any:
    """Call a function, made in this module of LLVM if it is not there; return its results."""
    module, results = builder.module, _results(function)
    made = module.globals.get(function.name)
    if made is None:
        returned = ir.LiteralStructType([_FLOAT] * len(results)) if results else ir.VoidType()
        kind = ir.FunctionType(returned, [number.type for number in numbers])
        made = ir.Function(module, kind, function.name)
        made.linkage = "internal"
        inside = ir.IRBuilder(made.append_basic_block())
        given = [argument.arg for argument in function.args.args]
        body = _Instructions(context, inside, names, dict(zip(given, made.args, strict=True)))
        for statement in function.body:
            body.add(statement)
        if not results:
            inside.ret_void()
    found = builder.call(made, numbers)
    if not results:
        return context.get_dummy_value()
    return [builder.extract_value(found, i) for i in range(len(results))]


class _Instructions:
    """Instructions of a function, from its statements; `values` are those of its names."""

    def __init__(
        self, context: Any, builder: Any, names: Mapping[str, Any], values: dict[str, Any]
    ) -> None:
        self.context, self.builder, self.names, self.values = context, builder, names, values

    def add(self, statement: Any) -> None:
        """Add what a statement does."""
        match statement:
            case ast.Assign(targets=[ast.Tuple(elts=places)], value=called):
                for place, value in zip(places, self.call(called), strict=True):
                    self.assign(place, value)
            case ast.Assign(targets=[place], value=node):
                self.assign(place, self.value(node))
            case ast.For(target=ast.Name(id=name), iter=ast.Call(args=[count]), body=body):
                self.repeat(name, self.value(count), body)
            case ast.Return(value=ast.Tuple(elts=results)):
                found = ir.Constant(self.builder.function.function_type.return_type, ir.Undefined)
                for i, result in enumerate(results):
                    found = self.builder.insert_value(found, self.value(result), i)
                self.builder.ret(found)
            case _:
                raise NotImplementedError(ast.unparse(statement))

    def assign(self, place: Any, value: Any) -> None:
        """Give a name or an element of an array a value."""
        if isinstance(place, ast.Name):
            self.values[place.id] = value
        else:
            self.builder.store(value, self.element(place))

    def repeat(self, name: str, count: Any, statements: Sequence[Any]) -> None:
        """Add a loop over whole numbers from 0 to below a count of at least one."""
        builder, before = self.builder, self.builder.block
        turn = builder.append_basic_block()
        builder.branch(turn)
        builder.position_at_end(turn)
        number = self.values[name] = builder.phi(_INT)
        number.add_incoming(_INT(0), before)
        for statement in statements:
            self.add(statement)
        following = builder.add(number, _INT(1))
        number.add_incoming(following, builder.block)
        after = builder.append_basic_block()
        builder.cbranch(builder.icmp_signed("<", following, count), turn, after)
        builder.position_at_end(after)

    def value(self, node: Any) -> Any:
        """Return the value of an expression: of a comparison, a float or, as an index, an int."""
        builder = self.builder
        match node:
            case ast.Name(id=name):
                return self.values[name]
            case ast.Constant(value=number):
                return _INT(number) if isinstance(number, int) else _FLOAT(number)
            case ast.Subscript():
                return builder.load(self.element(node))
            case ast.BinOp(left=left, op=operation, right=right):
                one, other = self.value(left), self.value(right)
                kind = "f" if one.type is _FLOAT else ""
                return getattr(builder, kind + _OPERATIONS[type(operation)])(one, other)
            case ast.UnaryOp(operand=operand):
                return builder.fneg(self.value(operand))
            case ast.IfExp(test=test, body=body, orelse=orelse):
                return builder.select(*map(self.value, (test, body, orelse)))
            case ast.Compare(left=left, ops=[operation], comparators=[right]):
                one, other = self.value(left), self.value(right)
                if isinstance(operation, ast.Gt):
                    return builder.fcmp_ordered(">", one, other)
                return builder.icmp_signed("==", one, other)
            case ast.Call(func=ast.Name(id="max"), args=[first, second]):
                one, other = self.value(first), self.value(second)
                return builder.select(builder.fcmp_ordered(">", other, one), other, one)
            case ast.Call(func=ast.Name(id=name), args=given):
                function = abs if name == "abs" else getattr(math, name)
                floats = signature(*[types.float64] * (1 + len(given)))
                compute = self.context.get_function(function, floats)
                return compute(builder, [self.value(one) for one in given])
        raise NotImplementedError(ast.unparse(node))

    def element(self, node: Any) -> Any:
        """Return the address of an element of an array."""
        return self.builder.gep(self.values[node.value.id], [self.value(node.slice)])

    def call(self, node: Any) -> Any:
        """Return the results of another straight-line function."""
        other, given = self.names[node.func.id].function, [*map(self.value, node.args)]
        return _call(other, self.names, self.context, self.builder, given)
