"""Shapes and types are checked in the first calls of every function in each test.

jaxtyping's own decorator writes and compiles two functions for every function that it checks, which
took a fifth of the time of tests: for functions that are never called too, and again and again for
functions inside functions. It also checks every call, although some are called thousands of times.
Here annotations are read at a function's first call, beartype keeps one check for each of them, and
a function that passed often enough is called without checks until the next test.
"""

from __future__ import annotations

import functools
import inspect
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import is_dataclass
from types import CodeType, FunctionType
from typing import Any, ForwardRef, ParamSpecArgs, ParamSpecKwargs, get_type_hints

import jaxtyping
from beartype.door import is_bearable

CHECKED_CALLS = 10
"""In each test so many calls of every function are checked."""

_checked: Counter[CodeType] = Counter()
_checking = threading.local()
_hints: dict[tuple[int, str], Any] = {}


def begin_test() -> None:
    """Check every function again."""
    _checked.clear()


def install() -> None:
    """Take jaxtyping's place in modules that its import hook loads from now on."""
    _within_one_call = jaxtyping.jaxtyped

    def decorator(*, typechecker: Callable[[Any], Any]) -> Callable[[Any], Any]:
        return functools.partial(_decorated, one_call=lambda: _within_one_call("context"))

    jaxtyping.jaxtyped = decorator


def _decorated(checkable: Any, one_call: Callable[[], Any]) -> Any:
    if isinstance(checkable, FunctionType):
        return _sparing(checkable, one_call)
    # Of a class, the __init__ that its fields have given it; what it defines is a function above.
    own = vars(checkable).get("__init__") if is_dataclass(checkable) else None
    if isinstance(own, FunctionType) and not hasattr(own, "__wrapped__"):
        checkable.__init__ = _sparing(own, one_call)
    return checkable


def _sparing(function: FunctionType, one_call: Callable[[], Any]) -> Any:
    code, checks = function.__code__, None

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal checks
        if _checked[code] >= CHECKED_CALLS or jaxtyping.config.jaxtyping_disable:
            return function(*args, **kwargs)
        _checked[code] += 1
        if checks is None:
            checks = _Checks(function)
        # Names of sizes mean the same for the arguments and the result of one call.
        with one_call():
            checks.arguments(args, kwargs)
            result = function(*args, **kwargs)
            checks.value("the result", result, checks.result)
            return result

    return call


class _Checks:
    """What the annotations of a function say."""

    def __init__(self, function: FunctionType) -> None:
        self.function = function
        signature = inspect.signature(function)
        self.by_name: dict[str, Any] = {}
        self.by_place: list[str] = []
        self.other_places = self.other_names = Any
        for name, parameter in signature.parameters.items():
            hint = self._hint(parameter.annotation)
            if parameter.kind is parameter.VAR_POSITIONAL:
                self.other_places = hint
            elif parameter.kind is parameter.VAR_KEYWORD:
                self.other_names = hint
            else:
                self.by_name[name] = hint
                if parameter.kind is not parameter.KEYWORD_ONLY:
                    self.by_place.append(name)
        self.result = self._hint(signature.return_annotation)

    def arguments(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        for name, value in zip(self.by_place, args, strict=False):
            self.value(name, value, self.by_name[name])
        for value in args[len(self.by_place) :]:
            self.value("an argument", value, self.other_places)
        for name, value in kwargs.items():
            self.value(name, value, self.by_name.get(name, self.other_names))

    def value(self, name: str, value: Any, hint: Any) -> None:
        # While beartype makes a check, under a lock, it may import a module, and jaxcal's finder of
        # modules is called: checked as well, it would wait for that lock for ever.
        if hint is Any or getattr(_checking, "now", False):
            return
        _checking.now = True
        try:
            passed = is_bearable(value, hint)
        finally:
            _checking.now = False
        if not passed:
            where = f"{self.function.__module__}.{self.function.__qualname__}"
            raise jaxtyping.TypeCheckError(f"{where}, {name}: {repr(value)[:200]} is no {hint}")

    def _hint(self, annotation: Any) -> Any:
        """What an annotation means in the function's module; Any where it has no meaning there."""
        if annotation is inspect.Parameter.empty:
            return Any
        where = self.function.__globals__
        key = (id(where), annotation)
        if key not in _hints:

            def read(value): ...

            read.__annotations__ = {"value": annotation}
            try:
                hint = get_type_hints(read, where, include_extras=True)["value"]
            # Names for the type checker alone, and those of functions around this one.
            except Exception:
                hint = Any
            bound = getattr(hint, "__bound__", None)
            if isinstance(bound, ForwardRef):
                hint = self._hint(bound.__forward_arg__)
            # Arguments of a function that a decorator calls: any.
            elif isinstance(hint, (ParamSpecArgs, ParamSpecKwargs)):
                hint = Any
            _hints[key] = hint
        return _hints[key]
