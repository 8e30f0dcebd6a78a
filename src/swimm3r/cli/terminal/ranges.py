"""Records and arguments on the command line, as help shows them and as they are checked.

Ranges are declared with a setting or an argument, shown in its help, and checked where it is parsed.

Tyro leaves foreign metadata of `Annotated` aside. Here every hint that declares a range gets a constructor beside it,
so that a refusal names the option as it was written: --splat.rates.xyz.
"""

import inspect
from collections.abc import Callable
from dataclasses import is_dataclass, replace
from functools import partial, wraps
from types import NoneType
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import docstring_parser
from tyro.conf import arg
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructTypeInfo,
    UnsupportedTypeAnnotationError,
)

from swimm3r.settings import accepted, ranges_of


def settings_with_ranges() -> ConstructorRegistry:
    """Tyro's rules, and one for records: ranges, and help strings without the line breaks of their source."""
    registry = ConstructorRegistry()
    inside: list[type] = []  # a record whose fields tyro's own rule is listing

    @registry.struct_rule
    def list_fields(info: StructTypeInfo) -> StructConstructorSpec | None:
        if inside or not is_dataclass(info.type):
            return None
        inside.append(info.type)
        try:
            record = ConstructorRegistry.get_struct_spec(info)
        finally:
            inside.pop()
        if not isinstance(record, StructConstructorSpec):
            return None
        fields = (
            replace(field, type=parsed(field.type), helptext=partial(_unbroken, field.helptext))
            for field in record.fields
        )
        return replace(record, fields=tuple(fields))

    return registry


def with_ranges(command: Callable) -> Callable:
    """A command whose arguments are checked against the ranges that its signature declares.

    Their help strings, too, have no line breaks of their source.
    """
    hints = {name: parsed(hint) for name, hint in get_type_hints(command, include_extras=True).items()}
    for one in docstring_parser.parse(inspect.getdoc(command) or "").params:
        if one.description:
            hints[one.arg_name] = Annotated[hints[one.arg_name], arg(help=_unbroken(one.description))]

    @wraps(command)
    def call(*arguments: Any, **options: Any) -> None:
        command(*arguments, **options)

    given = inspect.signature(command)
    found = [one.replace(annotation=hints.get(name, one.annotation)) for name, one in given.parameters.items()]
    setattr(call, "__signature__", given.replace(parameters=found))  # noqa: B010 - functions have it, type stubs not
    call.__annotations__ = hints
    del call.__wrapped__  # tyro would read that one's hints
    return call


def parsed(hint: Any) -> Any:
    """A type hint with a constructor beside it where it holds a range, or None as one of its values.

    None can be given but is not shown: as a default it stands for what the help string says.
    """
    ranges = list(ranges_of(hint))
    kind = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    optional = NoneType in get_args(kind)
    if not (ranges or optional) or any(isinstance(part, PrimitiveConstructorSpec) for part in get_args(hint)):
        return hint
    plain = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(hint, set()))
    assert not isinstance(plain, UnsupportedTypeAnnotationError)

    metavar = plain.metavar.replace("{None}|", "").replace("{None,", "{")
    for number in ("INT", "FLOAT"):
        metavar = metavar.replace(number, ranges[0].brief(number)) if ranges else metavar
    construct = partial(_construct, plain, hint) if ranges else plain.instance_from_str
    spec = replace(plain, metavar=metavar, instance_from_str=construct)
    return Annotated[hint, spec, arg(help_behavior_hint=_default_shown)] if optional else Annotated[hint, spec]


def _construct(plain: PrimitiveConstructorSpec, hint: Any, words: list[str]) -> Any:
    return accepted("", plain.instance_from_str(words), hint)


def _default_shown(default: str) -> str:
    return "(optional)" if default == "None" else f"(default: {default})"


def _unbroken(text: str | Callable[[], str | None] | None) -> str | None:
    """A help string as one line, which tyro breaks to the width of the terminal."""
    found = text() if callable(text) else text
    return None if found is None else " ".join(found.split())
