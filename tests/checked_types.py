"""Checks of the package's annotations at run time, as cheap as the suite needs them.

jaxtyping's hook calls `jaxtyping.jaxtyped` on each function. Of one whose annotations hold shapes that decorator checks
every parameter twice, and of one without shapes it keeps a record of axes that nothing reads. Here beartype looks at
each function once, and only functions with shapes get a record of axes around it: the same violations are found.
"""

import dataclasses
import inspect
from collections.abc import Callable
from functools import partial, wraps
from types import CodeType
from typing import Any, get_args, get_type_hints

import jaxtyping
from jaxtyping import AbstractArray, install_import_hook

_jaxtyped = jaxtyping.jaxtyped


def check_annotations(package: str) -> None:
    """Check what is passed to and returned by every function of a package that is not imported yet."""
    # ints may stand for floats, as PEP 484 says
    install_import_hook(package, "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")
    jaxtyping.jaxtyped = checked


def checked(function: Any = None, *, typechecker: Callable) -> Any:
    """Takes the place of `jaxtyping.jaxtyped`: the function or dataclass with its checks around it."""
    if function is None:  # the form with parentheses
        return partial(checked, typechecker=typechecker)
    if inspect.isclass(function):
        if dataclasses.is_dataclass(function) and "__init__" in vars(function):
            setattr(function, "__init__", checked(function.__init__, typechecker=typechecker))  # noqa: B010
        return function
    if not inspect.isfunction(function) or inspect.isgeneratorfunction(function):
        return _jaxtyped(function, typechecker=typechecker)
    try:
        hints = get_type_hints(function, include_extras=True)
    except NameError:  # a name that is local, or not there yet
        return _jaxtyped(function, typechecker=typechecker)
    once = typechecker(function)
    if any(map(_has_shape, hints.values())):
        return _jaxtyped(once, typechecker=None)
    return _with_axes_of_its_own(once) if _asks_for_types(function.__code__) else once


def _with_axes_of_its_own(function: Callable) -> Callable:
    """The function, in whose body `isinstance(x, Float[...])` does not see the axes of its caller."""

    @wraps(function)
    def call(*arguments: Any, **options: Any) -> Any:
        with _jaxtyped("context"):
            return function(*arguments, **options)

    return call


def _asks_for_types(code: CodeType) -> bool:
    return "isinstance" in code.co_names or any(_asks_for_types(c) for c in code.co_consts if isinstance(c, CodeType))


def _has_shape(hint: Any) -> bool:
    return (isinstance(hint, type) and issubclass(hint, AbstractArray)) or any(map(_has_shape, get_args(hint)))
