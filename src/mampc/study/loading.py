"""Reading study files, and saying what is wrong with them: each wrong key, its place, what was expected."""

from __future__ import annotations

import difflib
import re
import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from mampc.base.errors import MampcError, StudyError, shown
from mampc.base.files import read_text
from mampc.study.schema import Place, Study
from mampc.study.values import Table

STUDY_FILE_LIMIT = 2**18  # bytes
LONGEST_LINE = 2000  # characters; the time that keys of many parts take grows with the square of their length
MOST_COMPLAINTS = 20
LONGEST_COMPLAINT = 300  # characters


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
            f"received {shown(str(source), 200)}"
        )
    folder = path.resolve().parent
    if trust is None:
        trust = folder.is_relative_to(Path.cwd().resolve())
    try:
        text = read_text(path, STUDY_FILE_LIMIT, "TOML file")
    except MampcError as error:
        raise StudyError(str(error)) from None
    return parse_study(text, str(path), trust=trust, folder=folder)


def parse_study(
    text: str, origin: str = "study", *, trust: bool = False, folder: Path | None = None
) -> Study:
    """Check the TOML text of a study.

    Args:
        text: of the study.
        origin: how messages call it.
        trust: whether a plant named `module:Class` may be imported; text does not tell where it comes from.
        folder: in which files and modules that it names are looked for; default the current one.

    Raises:
        StudyError: names each wrong key, its place, and what was expected there.
    """
    if len(text) > STUDY_FILE_LIMIT:
        raise StudyError(f"{origin}: expected at most {STUDY_FILE_LIMIT} characters, received {len(text)}")
    for number, line in enumerate(text.split("\n"), 1):
        if len(line) > LONGEST_LINE:
            raise StudyError(
                f"{origin}: expected lines of at most {LONGEST_LINE} characters, received {len(line)} in line "
                f"{number}; lists may go on in the next line"
            )
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise StudyError(f"{origin}: expected TOML, received: {error}") from None
    if "place" in content:
        raise StudyError(f"{origin}: study not accepted\n  place: unknown key")
    try:
        study = Study.model_validate(content)
    except ValidationError as error:
        raise StudyError(_complaints(origin, error)) from None
    return study.model_copy(update={"place": Place(Path() if folder is None else folder, trust)})


def _complaints(origin: str, error: ValidationError) -> str:
    """One line per wrong key: where it is, what was expected, what came."""
    lines: dict[str, None] = {}  # a union reports each of its branches; one line a place is enough
    for problem in error.errors(include_url=False):
        if len(lines) == MOST_COMPLAINTS:
            lines["  and more like these"] = None
            break
        line = _complaint(problem)
        lines[line if len(line) <= LONGEST_COMPLAINT else f"{line[: LONGEST_COMPLAINT - 3]}..."] = None
    return "\n".join([f"{origin}: {error.title.lower()} not accepted", *lines])


def _complaint(problem: Any) -> str:
    place = _place(problem["loc"])
    received = "" if isinstance(problem["input"], dict) else f", received {shown(problem['input'])}"
    if problem["type"] == "extra_forbidden":
        known = _known_keys(problem["loc"][:-1])
        close = difflib.get_close_matches(str(problem["loc"][-1]), known, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"expected one of {', '.join(known)}"
        return f"  {place}: unknown key; {hint}"
    if problem["type"] == "missing":
        return f"  {place}: expected this key, received none"
    if problem["type"] == "value_error":
        return f"  {place}: expected {problem['ctx']['error']}{received}"
    message = problem["msg"].removeprefix("Input should be ")
    return f"  {place}: expected {message}{received}"


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
    return sorted(set(table.model_fields) - {"place"})


def _table_of(annotation: Any) -> Any:
    """The table class inside an annotation such as list[X] or X | None."""
    for inner in getattr(annotation, "__args__", ()):
        found = _table_of(inner)
        if found is not None:
            return found
    return annotation if isinstance(annotation, type) and issubclass(annotation, Table) else None
