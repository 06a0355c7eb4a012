"""Parse JSON, YAML and XML from language models, despite comments, trailing commas, missing brackets or extra text."""

from __future__ import annotations

import ast
import json
import re
import warnings
from contextlib import suppress
from typing import Any
from xml.etree import ElementTree

from lw_torchrl.language.formats.phrases import role_of

_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*"|//[^\n]*|/\*.*?\*/|#[^\n]*|[^"\[\]{},/#]+|.', re.DOTALL)
_YAML = re.compile(r"^[ \t]*(?:(?:- )?[\w -]{1,40}:(?:\s|$)|- [\[{])", re.MULTILINE)
_BEGINNING = re.compile(r"\s*(?:#|- |\w[^:.\n]*\?:)")  # other beginnings of YAML
_TAGS = ("selector", "sequence", "test", "act")
_MOST_DEPTH = 1_000
_CODE = re.compile(  # a definition, or a call below the head of a block
    r"^[ \t]*(?:(?:async )?(?:def|class) \w|(?:if|elif|while|for) [^\n]*:[ \t]*(?:#[^\n]*)?\n[ \t]+[\w.]+\()",
    re.MULTILINE,
)
_TAG = re.compile(r"^[ \t]*<[A-Za-z][^<>]*>", re.MULTILINE)
_COMMENT = re.compile(r"^[ \t]*#(?: |$).*$", re.MULTILINE)
_DOCUMENT = re.compile(r"^(?:---|\.\.\.)[ \t]*$", re.MULTILINE)


def parse_value(text: str) -> Any:
    """Parse the JSON, YAML or XML in a text. Return a list if there are several values, and None if there is none.

    An XML element becomes an object with its tag as "type".

    Raises:
        ImportError: the text may be YAML, and PyYAML is not installed.
        ValueError: the XML nests more than 500 levels deep, or the JSON more than 1,000 and is invalid.

    Example:
        >>> parse_value('Here: {"if": "gripper open", /* wide */ "do": ["close", "lift",')
        {'if': 'gripper open', 'do': ['close', 'lift']}
    """
    if _CODE.search(text):
        return None
    text = _COMMENT.sub("", text)
    bracket = re.search(r"[{\[]", text)
    before = text if bracket is None else text[: bracket.start()]
    if (tag := _TAG.search(before)) and len(_TAG.findall(text)) > 2 and (value := _xml(text[tag.start() :])):
        return value
    is_yaml = len(_YAML.findall(text if bracket is None else text[: bracket.end()])) > 1
    value = None if is_yaml or bracket is None else _json(text[bracket.start() :])
    return _yaml(text) if value is None and len(_YAML.findall(text)) > 1 else value


def _json(text: str) -> Any:
    values, rest = list[Any](), text
    with suppress(ValueError, RecursionError):
        while rest[:1] in ("{", "["):
            value, end = json.JSONDecoder().raw_decode(rest)
            values, rest = [*values, value], rest[end:].lstrip()
    if values:
        return values if len(values) > 1 else values[0]
    repaired = _repaired(text)
    with suppress(ValueError, RecursionError):
        return json.loads(repaired)
    with suppress(ValueError, TypeError, SyntaxError, RecursionError, MemoryError), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about invalid escapes in the text
        return ast.literal_eval(repaired)
    with suppress(ImportError):
        return _yaml(repaired) if ":" in repaired else None  # keys without quotes
    return None


def _repaired(text: str) -> str:
    """Return the JSON at the beginning of a text without comments and trailing commas, and with closing brackets."""
    parts, closers = list[str](), list[str]()
    for token in _TOKEN.findall(text):
        if token[:2] in ("//", "/*") or token[0] == "#" or token.isspace():
            continue
        if token in ("]", "}"):
            if not closers:
                break
            closers.pop()
            while parts[-1] == ",":
                parts.pop()
        parts.append(token)
        if token in ("[", "{"):
            closers.append("]" if token == "[" else "}")
            if len(closers) > _MOST_DEPTH:
                raise ValueError(f"a value must nest at most {_MOST_DEPTH} others")
        if not closers:
            break
    while closers and parts and not (parts[-1] in "]}[{" or (parts[-1][-1] == '"' and len(parts[-1]) > 1)):
        parts.pop()  # part of a value that is cut off
    if len(parts) > 1 and closers and closers[-1] == "}" and parts[-1][-1] == '"' and parts[-2].strip() != ":":
        parts.pop()  # a key without a value
    while parts and parts[-1] == ",":
        parts.pop()
    return "".join([*parts, *reversed(closers)])


def _xml(text: str) -> Any:
    """Parse XML, which may be cut off; None if the text has no elements."""
    is_closed = re.search(r"</[A-Za-z]|/>", text)  # unlike <img> in HTML
    if not is_closed or "<!DOCTYPE" in text or "<!ENTITY" in text:
        return None
    parser: Any = ElementTree.XMLPullParser(["start"])
    with suppress(ElementTree.ParseError):
        parser.feed(text)
    with suppress(ElementTree.ParseError):
        for _, element in parser.read_events():
            return _element(element, 0)
    return None


def _element(element: ElementTree.Element, depth: int) -> dict[str, Any]:
    if depth > _MOST_DEPTH // 2:
        raise ValueError(f"a value must nest at most {_MOST_DEPTH // 2} others")
    row: dict[str, Any] = {**({} if element.tag == "root" else {"type": element.tag}), **element.attrib}
    inner = [(child.tag, _element(child, depth + 1), child.attrib) for child in element]
    if inner and not any(attributes for *_, attributes in inner) and len({tag for tag, *_ in inner}) == len(inner):
        row |= {tag: value.get(tag, {**value, "type": None}) for tag, value, _ in inner}
    elif inner:
        row["children"] = [value for _, value, _ in inner]
    elif text := (element.text or "").strip():
        row = {element.tag: text, **element.attrib}
    return row


def _yaml(text: str) -> Any:
    """Parse YAML, with all scalars as strings and several documents as a list; return None if it is not YAML."""
    if len(documents := _DOCUMENT.split(text)) > 1:
        values = [value for value in map(_yaml, documents) if isinstance(value, dict | list)]
        return values if len(values) > 1 else values[0] if values else None
    import yaml  # type: ignore[import-untyped]

    class Loader(getattr(yaml, "CBaseLoader", yaml.BaseLoader)):  # type: ignore[misc]
        """A YAML loader that reads the tag "!selector [...]" as {"selector": [...]}."""

    def tagged(loader: Any, tag: str, node: Any) -> dict[str, Any]:
        if isinstance(node, yaml.ScalarNode):
            return {tag: loader.construct_scalar(node)}
        is_list = isinstance(node, yaml.SequenceNode)
        return {tag: (loader.construct_sequence if is_list else loader.construct_mapping)(node, deep=True)}

    Loader.add_multi_constructor("!", tagged)

    def quoted(found: re.Match[str]) -> str:
        tag = found[2][1:].split()[0] if found[2][1:].split() else ""
        return found[0] if role_of(tag) in _TAGS else f'{found[1]}"{found[2]}"'  # "!" negates, or marks an action

    text = re.sub(r"((?:: |- ) *)(!\S[^\n]*)", quoted, text)
    text = re.sub(r"^([ \t]*(?:- )?)case (?=[^:\n]+:)", r"\1when ", text, flags=re.MULTILINE)
    paragraphs = re.split(r"\n\s*\n", text)
    while paragraphs and not (_YAML.match(paragraphs[0].lstrip()) or _BEGINNING.match(paragraphs[0])):
        paragraphs.pop(0)  # sentences around the YAML
    while paragraphs and not _YAML.search(paragraphs[-1]):
        paragraphs.pop()
    keys = re.findall(r"^\w[\w ]*:", text := "\n\n".join(paragraphs) or text, re.MULTILINE)
    if len({*keys}) < len(keys):
        return None  # prose with labels; YAML would keep only the last
    with suppress(yaml.YAMLError, ValueError, RecursionError):
        return yaml.load(text, Loader)
    return None
