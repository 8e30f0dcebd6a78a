"""Options that several commands have: one name, one short form and one meaning each."""

from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

FLAT: Any = arg(name="")
"""Marks a record whose fields are options without the record's name before them: --fps, not --frames.fps."""

Out = Annotated[Path, arg(aliases=("-o",))]
OutOrDefault = Annotated[Path | None, arg(aliases=("-o",))]
Source = Positional[Annotated[Path, arg(metavar="SOURCE")]]
Run = Positional[Annotated[Path, arg(metavar="RUN")]]
Runs = Positional[Annotated[tuple[Path, ...], arg(metavar="RUN [RUN ...]", help_behavior_hint="(one or more)")]]
DataRoot = Positional[Annotated[Path, arg(metavar="DATA")]]
