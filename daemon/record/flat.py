"""Recorded messages as viewers can read them: each topic has a schema of its own, without
references, alternatives and tables, and each message holds to it."""

from __future__ import annotations

from itertools import chain
from typing import Any, Final

import msgspec
from msgspec import inspect

from drivers.base import ELECTRODES

JsonSchema = dict[str, Any]
BOUNDS: Final = {"ge": "minimum", "le": "maximum", "max_length": "maxItems", "pattern": "pattern"}
"""What limits a value, in the words of `msgspec.Meta` and of JSON Schema."""


def flat(value: object) -> object:
    """A message's content, as JSON has it, for a recording.

    What is null is left out, and the rows of a table follow each other in one list.
    """
    if isinstance(value, dict):
        return {name: flat(one) for name, one in value.items() if one is not None}
    if isinstance(value, list) and value and isinstance(value[0], list):
        return list(chain.from_iterable(value))
    return value


def table(values: object) -> object:
    """The counts of a recorded message by finger: rows of 24, as older recordings have them."""
    if not isinstance(values, list) or not values or isinstance(values[0], list):
        return values
    return [values[first : first + ELECTRODES] for first in range(0, len(values), ELECTRODES)]


def schema_of(message: type[msgspec.Struct]) -> JsonSchema:
    """JSON Schema of what `flat` makes of messages of a type.

    Raises `TypeError` for a type that has a field that no viewer could read.
    """
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **_schema(inspect.type_info(message)),
    }


def _schema(kind: inspect.Type) -> JsonSchema:
    if isinstance(kind, inspect.Metadata):
        return {**_schema(kind.type), **(kind.extra_json_schema or {})}
    if isinstance(kind, inspect.UnionType):
        return _schema(_without_null(kind))
    if isinstance(kind, inspect.StructType):
        return _object(kind)
    if isinstance(kind, inspect.DictType):
        names = _values(kind.key_type)
        return {
            "type": "object",
            "properties": {name: _schema(kind.value_type) for name in names},
            "additionalProperties": _schema(kind.value_type),
        }
    if isinstance(kind, inspect.ListType | inspect.VarTupleType):
        return _array(kind)
    if isinstance(kind, inspect.EnumType | inspect.LiteralType):
        values = _values(kind)
        return {"type": "integer" if isinstance(values[0], int) else "string", "enum": values}
    if isinstance(kind, inspect.BytesType):
        return {"type": "string", "contentEncoding": "base64"}
    for plain, name in (
        (inspect.BoolType, "boolean"),
        (inspect.IntType, "integer"),
        (inspect.FloatType, "number"),
        (inspect.StrType, "string"),
    ):
        if isinstance(kind, plain):
            return {"type": name, **_bounds(kind)}
    raise TypeError(f"no viewer can read {kind}")


def _object(kind: inspect.StructType) -> JsonSchema:
    required = [
        field.encode_name
        for field in kind.fields
        if field.required and not isinstance(field.type, inspect.UnionType)
    ]
    described = {"description": kind.cls.__doc__.strip()} if kind.cls.__doc__ else {}
    return {
        "title": kind.cls.__name__,
        **described,
        "type": "object",
        "properties": {field.encode_name: _schema(field.type) for field in kind.fields},
        "required": required,
    }


def _array(kind: inspect.ListType | inspect.VarTupleType) -> JsonSchema:
    item = kind.item_type
    if isinstance(item, inspect.ListType):
        shape = f"Shape (fingers, {ELECTRODES}), row by row: finger f's electrode e is at "
        where = f"{ELECTRODES} * f + e - 1, with f from 0 and e from 1."
        return {"type": "array", "description": shape + where, "items": _schema(item.item_type)}
    return {"type": "array", "items": _schema(item)}


def _without_null(kind: inspect.UnionType) -> inspect.Type:
    others = [one for one in kind.types if not isinstance(one, inspect.NoneType)]
    if len(others) != 1:
        raise TypeError(f"no viewer can read {kind}")
    return others[0]


def _values(kind: inspect.Type) -> list[Any]:
    """What an enumeration or a literal may be, in its order; nothing for any other type."""
    if isinstance(kind, inspect.EnumType):
        return [member.value for member in kind.cls]
    return list(kind.values) if isinstance(kind, inspect.LiteralType) else []


def _bounds(kind: inspect.Type) -> JsonSchema:
    found = ((BOUNDS[name], getattr(kind, name, None)) for name in BOUNDS)
    return {name: value for name, value in found if value is not None}
