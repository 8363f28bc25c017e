# SPDX-License-Identifier: Apache-2.0
"""Checks of a section that has faults already: what the rest of it shows is told all the same."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NoReturn

from sst_ros.errors import Problem
from sst_ros.scene.schema import Section, specs


class _UnknownError(Exception):
    """A check asked for a part that is at fault itself."""


class _Unknown:
    """Stands for a part at fault: every question about it ends the check that asks."""

    def _refuse(self, *_: object) -> NoReturn:
        raise _UnknownError

    __getattr__ = __bool__ = __iter__ = __len__ = __float__ = __array__ = _refuse
    __eq__ = __ne__ = __lt__ = __le__ = __gt__ = __ge__ = __abs__ = __neg__ = _refuse
    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = _refuse


def problems(cls: type[Section], values: dict[str, Any]) -> Iterator[Problem]:
    """Yield what the checks of `cls` find in `values`, where None stands for a part at fault."""
    known = specs(cls)
    given = {name: _marked(value) for name, value in values.items() if name in known}
    partial = object.__new__(cls)
    for name in known:
        if name in given or not hasattr(cls, name):
            object.__setattr__(partial, name, given.get(name, _Unknown()))
    checks: tuple[Callable[[], Iterator[Problem]], ...] = partial.checks()
    for check in checks:
        try:
            yield from (fault for fault in check() if not isinstance(fault.value, _Unknown))
        except _UnknownError:
            continue


def _marked(value: Any) -> Any:
    if isinstance(value, dict):
        return tuple(value.items())
    if isinstance(value, tuple):
        return tuple(map(_marked, value))
    return _Unknown() if value is None else value
