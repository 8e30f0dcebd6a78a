"""Parts of a command's help: the options most users touch under titles of their purpose, or those of one record.

tyro makes the whole help from a command's signature. A view is a command with fewer options, sorted into other groups,
that is asked for nothing but its help. Names, types, defaults and help strings are those of the command itself.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass, make_dataclass
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import docstring_parser
from tyro.conf import Positional, arg
from tyro.constructors import MISSING_NONPROP, ConstructorRegistry, StructConstructorSpec, StructTypeInfo

from swimm3r.cli.terminal.options import FLAT

Groups = Mapping[str, Sequence[str]]
"""Names of options as they are typed (--fps), under the title that a help view gives them."""


@dataclass(frozen=True)
class Option:
    """One option of a command, or a positional argument of it."""

    name: str  # as typed: --splat.iterations; a positional argument's is its parameter's
    group: str  # the records that it is in: splat.densify; "" where it is the command's own
    hint: Any
    default: Any
    help: str

    @property
    def positional(self) -> bool:
        """Return whether it is given by its place among the arguments."""
        return not self.name.startswith("-")


@dataclass(frozen=True)
class View:
    """A command's help in part, and the lines below it."""

    command: Callable
    footer: str


@dataclass
class _Listed:
    options: list[Option] = field(default_factory=list)  # in the order of the whole help
    about: dict[str, str] = field(default_factory=dict)  # first line of each record's description


def options_of(command: Callable) -> list[Option]:
    """The options of a command in the order of its whole help."""
    return _listed(command).options


def groups_of(command: Callable) -> dict[str, str]:
    """The description of each record of a command."""
    return _listed(command).about


def brief_help(command: Callable, usage: str, shown: Groups) -> View:
    """The options of the groups that this command has, and where the others are explained."""
    listed = _listed(command)
    by_name = {one.name: one for one in listed.options}
    groups = {title: [by_name[name] for name in names if name in by_name] for title, names in shown.items()}
    hidden = sum(not one.positional for one in listed.options) - sum(map(len, groups.values()))
    records: dict[str, None] = {}  # those of the command, and those that are typed before an option
    for one in listed.options:
        if one.group:
            records |= dict.fromkeys([one.group.split(".")[0], *one.name.removeprefix("--").split(".")[:-1][:1]])
    footer = (
        f"{hidden} more options: {usage} --help-all\n"
        f"Options of one group: {usage} --help GROUP, with GROUP one of {', '.join(records)}"
    )
    return View(_command(command, listed, groups), footer)


def group_help(command: Callable, usage: str, group: str) -> View | None:
    """The options of one record and of the records in it; None where the command has no such record.

    The record may be named with those that it is in (splat.densify) or without (densify).
    """
    listed = _listed(command)
    groups: dict[str, list[Option]] = {}
    for one in listed.options:
        if f".{group}." in f".{one.group}.":
            groups.setdefault(one.group, []).append(one)
    return View(_command(command, listed, groups), f"All options: {usage} --help-all") if groups else None


def _listed(command: Callable) -> _Listed:
    listed = _Listed()
    hints = get_type_hints(command, include_extras=True)
    told = {one.arg_name: one.description or "" for one in docstring_parser.parse(inspect.getdoc(command) or "").params}
    for name, parameter in inspect.signature(command).parameters.items():
        default = MISSING_NONPROP if parameter.default is parameter.empty else parameter.default
        if parameter.kind is parameter.POSITIONAL_ONLY:
            listed.options.append(Option(name, "", hints[name], default, _help(hints[name], told.get(name, ""))))
        else:
            _list(listed, name, hints[name], default, told.get(name, ""))
    return listed


def _list(listed: _Listed, name: str, hint: Any, default: Any, told: str, group: str = "", prefix: str = "") -> None:
    """List an option, or those of the record that it stands for; `prefix` is typed before their names."""
    kind, *extras = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    typed = f"{prefix}{name.replace('_', '-')}"
    if not (isinstance(kind, type) and is_dataclass(kind)):
        listed.options.append(Option(f"--{typed}", group, hint, default, _help(hint, told)))
        return
    inside = f"{group}.{name}".lstrip(".")
    listed.about[inside] = told or (inspect.getdoc(kind) or "").splitlines()[0]
    record = ConstructorRegistry.get_struct_spec(StructTypeInfo.make(kind, default, False))
    assert isinstance(record, StructConstructorSpec)
    for one in record.fields:
        said = one.helptext() if callable(one.helptext) else one.helptext
        _list(listed, one.name, one.type, one.default, said or "", inside, prefix if FLAT in extras else f"{typed}.")


def _help(hint: Any, told: str) -> str:
    """The help string beside a type hint, else the one that a docstring has."""
    return next((extra.help for extra in get_args(hint)[1:] if getattr(extra, "help", None)), told)


def _command(command: Callable, listed: _Listed, groups: Mapping[str, Sequence[Option]]) -> Callable:
    """A command of the same purpose and positional arguments, with these groups of options."""

    def view(*_: Any, **__: Any) -> None:
        raise AssertionError("a help view is not run")

    positional, named = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.KEYWORD_ONLY
    parameters = [
        inspect.Parameter(one.name, positional, default=_default(one), annotation=_with_help(one))
        for one in listed.options
        if one.positional
    ]
    for number, (title, options) in enumerate(groups.items()):
        if options:
            record = _record(options, listed.about.get(title, ""))
            hint = Annotated[record, arg(name=title, help=listed.about.get(title, ""))]
            parameters.append(inspect.Parameter(f"group_{number}", named, annotation=hint))
    setattr(view, "__signature__", inspect.Signature(parameters))  # noqa: B010 - functions have it, type stubs not
    vars(view).pop("__wrapped__", None)  # of the test suite's checks; tyro would read that one's hints
    view.__annotations__ = {one.name: one.annotation for one in parameters}
    view.__doc__ = docstring_parser.parse(inspect.getdoc(command) or "").description
    return view


def _record(options: Sequence[Option], about: str) -> type:
    fields = [
        (
            f"option_{number}",
            Annotated[_with_help(one), arg(name=one.name.removeprefix("--"), prefix_name=False)],
            *([] if one.default is MISSING_NONPROP else [one.default]),
        )
        for number, one in enumerate(options)
    ]
    return make_dataclass("Group", fields, kw_only=True, frozen=True, namespace={"__doc__": about})


def _with_help(option: Option) -> Any:
    hint = Positional[option.hint] if option.positional else option.hint
    return Annotated[hint, arg(help=option.help)] if option.help else hint


def _default(option: Option) -> Any:
    return inspect.Parameter.empty if option.default is MISSING_NONPROP else option.default
