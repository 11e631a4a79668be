"""Changes of bench files and procedures that preserve comments, order and style (`ruamel.yaml`)."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable
from datetime import datetime
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from bench.base.files import read_regular, write_whole
from bench.base.yaml_files import Place, document_of, dotted, part, read_yaml, sha256_of_file, validated
from bench.config.bench_file.file import BenchFile
from bench.panel.bench_fields import (
    FORMS_OF_GRAVITY,
    GRAVITY,
    GRAVITY_FORM,
    ROLES,
    SUPPLY,
    BenchField,
    Group,
    Values,
    number_of_meters,
    number_of_rows,
    values_of,
    within,
)
from bench.services.errors import Refused
from bench.services.persons import checked_name, persons_of
from bench.services.requests.documents import ReadCertificate, Right
from bench.services.validated import laboratory_known
from drivers.clock import utc_now

if TYPE_CHECKING:
    from ruamel.yaml import YAML

WIDEST: Final = 4096
"""The longest line that is not broken."""
TABLES: Final = ("values", "rails")
_NOTHING: Final = re.compile(r"~|null", re.IGNORECASE)


def changed_text(text: str, values: Values, groups: Iterable[Group]) -> str:
    """Return the text of a bench file with the values of the form; an empty field removes its key.

    `groups` are the groups of the form; keys without a field stay unchanged. Raises `yaml.YAMLError` if the text is
    no YAML, `ImportError` without `ruamel.yaml`.
    """
    groups = list(groups)

    def arrange(tree: Any, before: Values) -> None:
        _arrange(tree, values, before, groups)

    return edited_text(text, values, [one for group in groups for one in group.fields], arrange)


def edited_text(
    text: str,
    values: Values,
    fields: Iterable[BenchField],
    arrange: Callable[[Any, Values], None] = lambda tree, before: None,
) -> str:
    """Return a YAML text with the `values` of its fields; if no data change, the text does not change either.

    An empty field removes its key. First, `arrange(tree, before)` adds and removes sections; `before` are the
    values in `text`. Raises the errors of `changed_text`.
    """
    yaml = _yaml()
    tree = yaml.load(text)
    before = values_of(read_yaml(text).data)
    arrange(tree, before)
    there = values_of(tree)
    before = {name: there.get(name, "") for name in before}
    for one in fields:
        wanted = values.get(one.name, "").strip()
        if not one.name.startswith("form:") and wanted != before.get(one.name, ""):
            _put(tree, one, wanted)
    out = io.StringIO()
    yaml.dump(tree, out)
    made = with_comments(text, out.getvalue())
    return text if read_yaml(made).data == read_yaml(text).data else made


def with_certificate(text: str, instrument: str, section: str) -> str:
    """Return a bench file's text with the certificate `section` (YAML) at an instrument; comments stay.

    Raises `KeyError` for an instrument that the text does not list, and the errors of `changed_text`.
    """

    def arrange(tree: Any, before: Values) -> None:
        instruments = tree["instruments"]
        meters = {f"voltmeter.{''.join(one['channels'])}": one for one in instruments.get("voltmeters", ())}
        named = {one["name"]: one for one in meters.values() if "name" in one}
        (meters | named | dict(instruments))[instrument]["certificate"] = _yaml().load(section)["certificate"]

    return edited_text(text, {}, (), arrange)


def accept_certificate(request: ReadCertificate, section: str) -> str:
    """Write an instrument's certificate `section` into a bench file; return a sentence that says what was written.

    The file's first line then names who accepted the certificate, and the SHA-256 of the document. Raises
    `Refused` if the bench file lacks the instrument or already has the certificate, or if the certificate has
    no corrections. Raises `FileMistakes`, without writing, if the changed file would have mistakes.
    """
    if request.into is None or not request.instrument or not request.by:
        raise Refused(
            "accepting a certificate needs --into FILE, --instrument NAME and --by NAME; add the missing ones"
        )
    name, path = checked_name(request.by), Path(request.into)
    if (register := persons_of(laboratory_known(None))) is not None:
        register.chosen(name, Right.AUTHORISE, "--by")
    digest = sha256_of_file(request.file)
    text = read_regular(path).decode()
    if digest in text:
        raise Refused(f"{path}: this certificate was accepted already; nothing was changed")
    if "values:" not in section:
        raise Refused(f"{request.file}: no corrections could be read; copy them by hand from the paper")
    try:
        made = with_certificate(text, request.instrument, section)
    except (KeyError, TypeError):
        raise Refused(f"{path}: lists no instrument {request.instrument}; name one such as head") from None
    day = utc_now().astimezone()
    made = f"# certificate of {request.instrument} accepted by {name} on {day:%Y-%m-%d}: SHA-256 {digest}\n{made}"
    validated(document_of(path, made.encode()), BenchFile)
    write_whole(path, made)
    return f"{path}: {request.instrument} has this certificate now; accepted by {name}"


def signed(text: str, name: str, now: datetime) -> str:
    """Return `text` below a comment that says who changed the file in the panel, and when."""
    kept = re.sub(r"\A# changed in the panel by [^\n]*\n", "", text)
    return f"# changed in the panel by {name} on {now.astimezone():%Y-%m-%d}\n{kept}"


def _yaml() -> YAML:
    """Return a YAML reader and writer that keeps every plain scalar unchanged, as text."""
    from ruamel.yaml import YAML
    from ruamel.yaml.resolver import VersionedResolver

    class Plain(VersionedResolver):
        """A resolver that reads every plain scalar as text."""

        @property
        def versioned_resolver(self) -> Any:
            """The patterns that give scalars a type; the only pattern makes an empty scalar null."""
            return {"": [("tag:yaml.org,2002:null", re.compile(r"^$"))]}

    yaml = YAML()
    yaml.Resolver = Plain
    yaml.preserve_quotes = True
    yaml.width = WIDEST
    yaml.brace_single_entry_mapping_in_flow_sequence = True
    yaml.indent(mapping=2, sequence=4, offset=2)
    return yaml


# --- sections that come and go ----------------------------------------------------------------------


def _arrange(tree: Any, values: Values, before: Values, groups: list[Group]) -> None:
    """Add and remove what the form's choices demand: instruments, rows of tables, the way of stating gravity."""
    stated = values.get(GRAVITY_FORM, "")
    if not stated:
        _remove(tree, GRAVITY)
    elif stated != before.get(GRAVITY_FORM, ""):
        tree["gravity"] = _gravity(stated)
    _arrange_instruments(tree, values)
    for group in groups:
        for one in group.fields:
            if one.rows is not None and isinstance(rows := part(tree, *one.at), list):
                del rows[number_of_rows(one.at, values) :]
        driver = dotted((*group.at, "driver"))
        if group.section is not None and values.get(driver, "") != before.get(driver, ""):
            section = _reach(tree, group.at)
            known = {info.alias or name for name, info in group.section.model_fields.items()}
            for key in [key for key in section if key not in known]:
                del section[key]
        certificate = (*group.at, "certificate")
        if within(certificate, before) and not any(
            values[name].strip() for name in within(certificate, values)
        ):
            _remove(tree, certificate)


def _arrange_instruments(tree: Any, values: Values) -> None:
    instruments = tree.get("instruments")
    if not isinstance(instruments, dict):
        instruments = tree["instruments"] = in_one_line({})
    meters = instruments.get("voltmeters")
    if not isinstance(meters, list):
        meters = instruments["voltmeters"] = in_one_line([])
    wanted = number_of_meters(values)
    while len(meters) > wanted:
        del meters[len(meters) - 1]
    while len(meters) < wanted:
        meters.append(in_one_line({}))
    for role in ROLES:
        stated = values.get(f"instruments.{role}.driver", "").strip()
        if not stated and instruments.pop(role, None) is not None and role == "power_supply":
            _remove(tree, SUPPLY)


def _gravity(stated: str) -> Any:
    """Return the section on gravity in the form `stated`; a value that stays empty becomes a mistake."""
    empty = _scalar("", None)
    if stated == FORMS_OF_GRAVITY["value"]:
        return empty
    section = in_one_line({})
    if stated == FORMS_OF_GRAVITY["source"]:
        section["value"] = empty
    return section


# --- values -----------------------------------------------------------------------------------------


def _put(tree: Any, one: BenchField, text: str) -> None:
    """Set the text of a field, and create the sections around it; an empty text removes the field's key."""
    if not text:
        _remove(tree, one.at)
        return
    section, key = _reach(tree, one.at[:-1]), one.at[-1]
    if key == "channels" or one.many:
        section[key] = in_one_line([part for word in text.split(",") if (part := word.strip())])
        return
    section[key] = _scalar(text, section.get(key) if isinstance(section, dict) else None)


def _scalar(text: str, before: Any) -> Any:
    """Return a text as a scalar with the quotes of the scalar `before`; what YAML reads as null is quoted."""
    from ruamel.yaml.scalarstring import DoubleQuotedScalarString, SingleQuotedScalarString

    if isinstance(before, SingleQuotedScalarString):
        return SingleQuotedScalarString(text)
    if isinstance(before, DoubleQuotedScalarString) or not text or _NOTHING.fullmatch(text) or "::" in text:
        return DoubleQuotedScalarString(text)
    return text


def _remove(tree: Any, at: Place) -> None:
    """Remove the key at a path, and the sections that become empty: of a list, the last row of a table."""
    section = tree
    for step in at[:-1]:
        if isinstance(section, dict) and step not in section:
            return
        section = section[step]
        if not isinstance(section, dict | list):
            return
    last_row = isinstance(section, list) and at[-2] in TABLES and at[-1] == len(section) - 1
    if last_row or (isinstance(section, dict) and at[-1] in section):
        del section[at[-1]]
        if not section and len(at) > 1 and (not isinstance(at[-2], int) or at[-3] in TABLES):
            _remove(tree, at[:-1])


def _reach(tree: Any, at: Place) -> Any:
    """Return the section at a path, after creating each missing section on the path as a one-line mapping."""
    section = tree
    for step, inner in zip_longest(at, at[1:]):
        if isinstance(section, dict) and not isinstance(section.get(step), dict | list):
            section[step] = in_one_line([] if isinstance(inner, int) else {})
        elif isinstance(section, list):
            section.extend(in_one_line({}) for _ in range(len(section), int(step) + 1))
        section = section[step]
    return section


def in_one_line(value: dict[str, str] | list[str]) -> Any:
    """Return a mapping or a list that YAML will write in one line."""
    from ruamel.yaml.comments import CommentedMap, CommentedSeq

    made: Any = CommentedMap(value) if isinstance(value, dict) else CommentedSeq(value)
    made.fa.set_flow_style()
    return made


# --- comments ---------------------------------------------------------------------------------------
# A round trip ties a comment to the value before it. Where that value goes, the comment would go or move with it.


def with_comments(before: str, after: str) -> str:
    """Return `after` with the whole-line comments of `before`, each above its key or the next key that remains."""
    blocks = _blocks(before)
    if _blocks(after) == blocks:
        return after
    lines = [line for line in after.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    paths = _paths(lines)
    found: dict[int, list[str]] = {}
    for comment, followers in blocks:
        where = next((paths.index(path) for path in followers if path in paths), len(lines))
        found.setdefault(where, []).extend(comment)
    result: list[str] = []
    for number, line in enumerate([*lines, None]):
        result += found.get(number, [])
        if line is not None:
            result.append(line)
    text = "\n".join(result) + "\n"
    return text if read_yaml(text).data == read_yaml(after).data else after


KeyPath = tuple[str, ...]


def _blocks(text: str) -> list[tuple[list[str], list[KeyPath]]]:
    """Return the blocks of comments and empty lines, each with the key paths of the lines that follow it."""
    lines = text.splitlines()
    aside = [not line.strip() or line.lstrip().startswith("#") for line in lines]
    paths = _paths([line for line, is_aside in zip(lines, aside, strict=True) if not is_aside])
    blocks: list[tuple[list[str], list[KeyPath]]] = []
    current: list[str] = []
    number = 0
    for line, is_aside in zip(lines, aside, strict=True):
        if is_aside:
            current.append(line)
            continue
        if current:
            blocks.append((current, paths[number:]))
            current = []
        number += 1
    return [*blocks, (current, [])] if current else blocks


_ITEM: Final = re.compile(r"( *)(- +)?([^:{\[]*)")


def _paths(lines: list[str]) -> list[KeyPath]:
    """Return, for each line of a YAML text in block style, the keys and list positions that lead to it."""
    paths: list[KeyPath] = []
    open_ones: list[tuple[int, str]] = []
    counts: dict[KeyPath, int] = {}
    for line in lines:
        match = _ITEM.match(line)
        indent, dash, key = (len(match[1]), match[2] or "", match[3].strip()) if match else (0, "", line)
        while open_ones and open_ones[-1][0] >= indent:
            open_ones.pop()
        outer = tuple(name for _, name in open_ones)
        if dash:
            counts[outer] = counts.get(outer, 0) + 1
            open_ones.append((indent, f"[{counts[outer]}]"))
            outer = (*outer, f"[{counts[outer]}]")
            indent += len(dash)
        paths.append(outer if dash else (*outer, key))
        open_ones.append((indent, key))
    return paths
