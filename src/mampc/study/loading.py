"""Reading study files, and saying what is wrong with them: each wrong key, its place, what was expected."""

from __future__ import annotations

import difflib
import re
import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from mampc.errors import StudyError
from mampc.study.schema import Study, Table

STUDY_FILE_LIMIT = 2**20  # bytes


def builtin_studies() -> list[str]:
    """Names of the studies that come with mampc."""
    return sorted(
        file.name.removesuffix(".toml")
        for file in files("mampc.studies").iterdir()
        if file.name.endswith(".toml")
    )


def template() -> str:
    """The commented text of a study, to start one's own from."""
    return files("mampc.studies").joinpath("quadruple-tank.toml").read_text(encoding="utf-8")


def load_study(source: str | Path, *, trust: bool | None = None) -> Study:
    """Read a built-in study by name, or a TOML file.

    Args:
        source: name or path.
        trust: whether a plant named `module:Class` may be imported; default if the file lies within the
            current folder.

    Raises:
        StudyError: no such study, or a file with wrong keys, types, values or units; names each.
    """
    if str(source) in builtin_studies():
        text = files("mampc.studies").joinpath(f"{source}.toml").read_text(encoding="utf-8")
        return parse_study(text, str(source))
    path = Path(source)
    if not path.is_file():
        raise StudyError(
            f"expected a built-in study ({', '.join(builtin_studies())}) or a TOML file, "
            f"received {str(source)!r}"
        )
    try:
        if path.stat().st_size > STUDY_FILE_LIMIT:
            raise StudyError(
                f"{path}: expected at most {STUDY_FILE_LIMIT} bytes, received {path.stat().st_size}"
            )
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise StudyError(f"{path}: expected a readable TOML file, received: {error}") from None
    study = parse_study(text, str(path))
    study._folder = path.resolve().parent
    study._trusted = study._folder.is_relative_to(Path.cwd().resolve()) if trust is None else trust
    return study


def parse_study(text: str, origin: str = "study") -> Study:
    """Check the TOML text of a study; `origin` is how messages call it.

    Raises:
        StudyError: names each wrong key, its place, and what was expected there.
    """
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise StudyError(f"{origin}: expected TOML, received: {error}") from None
    try:
        return Study.model_validate(content)
    except ValidationError as error:
        raise StudyError(_complaints(origin, error)) from None


def _complaints(origin: str, error: ValidationError) -> str:
    """One line per wrong key: where it is, what was expected, what came."""
    lines = []
    for problem in error.errors(include_url=False):
        place = _place(problem["loc"])
        received = "" if isinstance(problem["input"], dict) else f", received {problem['input']!r}"
        if problem["type"] == "extra_forbidden":
            known = _known_keys(problem["loc"][:-1])
            close = difflib.get_close_matches(str(problem["loc"][-1]), known, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"expected one of {', '.join(known)}"
            lines.append(f"  {place}: unknown key; {hint}")
        elif problem["type"] == "missing":
            lines.append(f"  {place}: expected this key, received none")
        elif problem["type"] == "value_error":
            lines.append(f"  {place}: expected {problem['ctx']['error']}{received}")
        else:
            message = problem["msg"].removeprefix("Input should be ")
            lines.append(f"  {place}: expected {message}{received}")
    # A union reports each of its branches; one line a place is enough.
    return "\n".join([f"{origin}: {error.title.lower()} not accepted", *dict.fromkeys(lines)])


def _place(location: tuple[int | str, ...]) -> str:
    """problem.limits.u_min, controllers[1].method; pydantic's names of union branches are left out."""
    text = ""
    for part in location:
        if isinstance(part, int):
            text += f"[{part}]"
        elif re.fullmatch(r"[A-Za-z_]\w*", part):
            if part in ("float", "int", "str", "bool") or part.startswith(("list", "constrained")):
                continue
            text += f".{part}" if text else part
    return text or "study"


def _known_keys(location: tuple[int | str, ...]) -> list[str]:
    table: Any = Study
    for part in location:
        if isinstance(part, str) and part in table.model_fields:
            table = _table_of(table.model_fields[part].annotation)
    return sorted(table.model_fields)


def _table_of(annotation: Any) -> Any:
    """The table class inside an annotation such as list[X] or X | None."""
    for inner in getattr(annotation, "__args__", ()):
        found = _table_of(inner)
        if found is not None:
            return found
    return annotation if isinstance(annotation, type) and issubclass(annotation, Table) else None
