"""Ranges on the command line: declared with a setting or an argument, shown in its help, checked where it is parsed.

Tyro leaves foreign metadata of `Annotated` aside. Here every hint that declares a range gets a constructor beside it,
so that a refusal names the option as it was written: --splat.rates.xyz.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from inspect import signature
from typing import Annotated, Any, get_args, get_type_hints

from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructTypeInfo,
    UnsupportedTypeAnnotationError,
)

from swimm3r.settings import Settings, accepted, ranges_of


def settings_with_ranges() -> ConstructorRegistry:
    """Tyro's rules, and one for settings records."""
    registry = ConstructorRegistry()
    inside: list[type] = []  # a record whose fields tyro's own rule is listing

    @registry.struct_rule
    def list_fields(info: StructTypeInfo) -> StructConstructorSpec | None:
        if inside or not (isinstance(info.type, type) and issubclass(info.type, Settings)):
            return None
        inside.append(info.type)
        try:
            record = ConstructorRegistry.get_struct_spec(info)
        finally:
            inside.pop()
        if not isinstance(record, StructConstructorSpec):
            return None
        return replace(record, fields=tuple(replace(field, type=parsed(field.type)) for field in record.fields))

    return registry


def with_ranges(command: Callable) -> Callable:
    """A command whose arguments are checked against the ranges that its signature declares."""
    hints = {name: parsed(hint) for name, hint in get_type_hints(command, include_extras=True).items()}

    @wraps(command)
    def call(*arguments: Any, **options: Any) -> None:
        command(*arguments, **options)

    given = signature(command)
    found = [one.replace(annotation=hints.get(name, one.annotation)) for name, one in given.parameters.items()]
    setattr(call, "__signature__", given.replace(parameters=found))  # noqa: B010 - functions have it, type stubs not
    call.__annotations__ = hints
    del call.__wrapped__  # tyro would read that one's hints
    return call


def parsed(hint: Any) -> Any:
    """A type hint with a constructor beside it where it holds a range."""
    ranges = list(ranges_of(hint))
    if not ranges or any(isinstance(part, PrimitiveConstructorSpec) for part in get_args(hint)):
        return hint
    plain = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(hint, set()))
    assert not isinstance(plain, UnsupportedTypeAnnotationError)

    def construct(words: list[str]) -> Any:
        return accepted("", plain.instance_from_str(words), hint)

    metavar = plain.metavar
    for kind in ("INT", "FLOAT"):
        metavar = metavar.replace(kind, ranges[0].brief(kind))
    return Annotated[hint, replace(plain, metavar=metavar, instance_from_str=construct)]
