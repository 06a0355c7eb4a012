"""What a model on this machine may be asked: each field of a request, and how much of it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from lw_torchrl._checks import nearest, shown
from lw_torchrl._files import parse_json
from lw_torchrl.planners.plan_schema import PATTERNS

MESSAGES, STOPS = 100, 8
_SCHEMA_DEPTH, _CHOICES, _ITEMS = 12, 1000, 64
_Check = tuple[Callable[[Any], bool], str]


class Refused(ValueError):
    """A request that is not answered.

    Attributes:
        status: the HTTP status that says why.
        code: the same in a word, as OpenAI's server says it.
    """

    def __init__(self, status: int, message: str, code: str = "invalid_request") -> None:
        super().__init__(message)
        self.status, self.code = status, code


def read_request(body: bytes, model: str, context: int) -> bytes:
    """A request to a model, as llama-cpp-python's server takes it: a schema is ``json_object`` there.

    Args:
        body: as it came.
        model: the only one there is; a request without a name means it too.
        context: tokens that an answer may have.

    Raises:
        Refused: it is no JSON, has a field that is not known, or one with something that is not allowed.
    """
    try:
        request = parse_json(body)
    except ValueError as error:
        raise Refused(400, f"the body must be an object in JSON: {error}") from None
    if request.get("model") not in (None, model):
        said = f"the model {shown(request['model'])} does not exist here; {model!r} is served"
        raise Refused(404, said, "model_not_found")
    if request.get("messages") is None:
        raise Refused(400, "messages must be given")
    known = _FIELDS | {"model": _one_of(None, model), "max_tokens": _number(1, context, whole=True)}
    for name, value in request.items():
        if name not in known:
            near = "".join(f"; did you mean {other!r}?" for other in nearest(name[:100], known, n=1))
            raise Refused(400, f"{shown(name)} is no field that this server knows, {', '.join(sorted(known))}{near}")
        right, allowed = known[name]
        if value is not None and not right(value):
            raise Refused(400, f"{name} must be {allowed}, got {shown(value)}")
    asked = request.get("response_format") or {}
    if asked.get("type") == "json_schema":
        request["response_format"] = {"type": "json_object", "schema": asked["json_schema"]["schema"]}
    given = {name: value for name, value in request.items() if value is not None}
    try:
        return json.dumps(given, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise Refused(400, "the body has half of a surrogate pair, which UTF-8 cannot hold") from None


def _number(least: float, most: float, whole: bool = False) -> _Check:
    kinds = (int,) if whole else (int, float)
    what = "an integer" if whole else "a number"
    return (lambda value: type(value) in kinds and least <= value <= most), f"{what} from {least} to {most}"


def _one_of(*allowed: Any) -> _Check:
    return (
        lambda value: any(type(value) is type(one) and value == one for one in allowed),
        " or ".join(map(json.dumps, allowed)),
    )


def _are_messages(value: Any) -> bool:
    return (
        isinstance(value, list)
        and 1 <= len(value) <= MESSAGES
        and all(
            isinstance(one, dict)
            and {*one} == {"role", "content"}
            and one["role"] in ("system", "user", "assistant")
            and isinstance(one["content"], str)
            for one in value
        )
    )


def _are_stops(value: Any) -> bool:
    stops = value if isinstance(value, list) else [value]
    return len(stops) <= STOPS and all(isinstance(stop, str) and 1 <= len(stop) <= 100 for stop in stops)


def _is_format(value: Any) -> bool:
    if not isinstance(value, dict):
        return False
    kind, rest = value.get("type"), {*value} - {"type"}
    if kind == "json_schema" and rest == {"json_schema"}:
        inside = value["json_schema"]
        return isinstance(inside, dict) and {"schema"} <= {*inside} <= {"name", "schema", "strict"} and _fits(inside)
    return (kind in ("text", "json_object") and not rest) or (
        kind == "json_object" and rest == {"schema"} and _fits(value)
    )


def _fits(holder: Mapping[str, Any]) -> bool:
    return _is_schema(holder["schema"], _SCHEMA_DEPTH)


def _is_schema(value: Any, depth: int) -> bool:
    """Whether it is one as :func:`plan_schema` makes them: others make grammars that fill the memory."""
    if not isinstance(value, dict) or depth == 0:
        return False
    names, kind = {*value}, value.get("type")
    if names == {"anyOf"}:
        return _listed(value["anyOf"], lambda one: _is_schema(one, depth - 1))
    if kind == "object" and names == {"type", "properties", "required", "additionalProperties"}:
        inside = value["properties"]
        return (
            isinstance(inside, dict)
            and 1 <= len(inside) <= _ITEMS
            and value["required"] == list(inside)
            and value["additionalProperties"] is False
            and all(_is_schema(one, depth - 1) for one in inside.values())
        )
    if kind == "array" and names == {"type", "items", "minItems", "maxItems"}:
        counts = value["minItems"], value["maxItems"]
        return (
            all(type(count) is int for count in counts)
            and 0 <= counts[0] <= counts[1] <= _ITEMS
            and _is_schema(value["items"], depth - 1)
        )
    if kind == "string" and names == {"type", "enum"}:
        return _listed(value["enum"], lambda one: isinstance(one, str) and len(one) <= 200)
    return kind == "string" and names == {"type", "pattern"} and value["pattern"] in [*PATTERNS]


def _listed(value: Any, right: Callable[[Any], bool]) -> bool:
    return isinstance(value, list) and 1 <= len(value) <= _CHOICES and all(map(right, value))


_FIELDS: dict[str, _Check] = {
    "messages": (_are_messages, f"1 to {MESSAGES} objects with role (system, user or assistant) and content, a text"),
    "response_format": (_is_format, "text, json_object, or json_schema with a schema as plan_schema makes it"),
    "stop": (_are_stops, f"up to {STOPS} texts of 1 to 100 characters"),
    "n": _one_of(1),
    "stream": _one_of(False),
    "seed": _number(-(2**63), 2**63, whole=True),
    "temperature": _number(0, 100),
    "top_p": _number(0, 1),
    "min_p": _number(0, 1),
    "top_k": _number(0, 10**6, whole=True),
    "presence_penalty": _number(-2, 2),
    "frequency_penalty": _number(-2, 2),
    "repeat_penalty": _number(0, 10),
}
