"""Tables of a user's own parts: each becomes tables that every problem file may have, which need no part any more."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from pydantic import Field, ValidationInfo, create_model

from vgtm_qp.errors import PartError, VgtmError
from vgtm_qp.parts import Kind, find_part, part_keys
from vgtm_qp.problem.fields import entry, unexpected
from vgtm_qp.problem.table import Table


def own_name(kind: Kind, table: Any, key: str) -> str | None:
    """Return the name of the part of one's own that a `key` of a table calls; None if it calls none.

    An error of the part itself becomes a mistake of the table.
    """
    name = entry(table, key) if isinstance(table, Mapping) else None
    try:
        return None if find_part(kind, name) is None else name
    except PartError as error:
        raise unexpected(f"a {kind} that can be used; {error}") from None


def own_answer(
    kind: Kind, name: str, table: Mapping[str, Any], key: str, shared: Iterable[str], info: ValidationInfo
) -> tuple[Any, dict[str, Any]]:
    """Return what a part makes of a table, and those values of the table that are `shared` keys of all such tables.

    The table has the keyword parameters of the part as its keys, with their types and defaults, and the shared keys.
    A ValidationError names unknown keys, missing ones and wrong types. What the part itself refuses by a ValueError, an
    ArithmeticError or an error of this package is a mistake of the table.
    """
    part = find_part(kind, name)
    assert part is not None
    keys, shared = part_keys(part), tuple(shared)
    others: dict[str, Any] = {other: (Any, None) for other in shared if other not in keys}
    fields: dict[str, Any] = {own: (kind_of, Field(default)) for own, (kind_of, default) in keys.items()}
    model = create_model(
        "OwnTable",
        __base__=Table,
        __cls_kwargs__={"called": f'a table of the {kind} "{name}"'},
        **{key: (str, ...), **others, **fields},
    )
    checked = model.model_validate(table, context=info.context)
    try:
        answer = part(**{own: getattr(checked, own) for own in keys})
    except (ValueError, ArithmeticError, VgtmError) as error:
        raise unexpected(f'values that the {kind} "{name}" takes; it says: {error}') from None
    return answer, {other: table[other] for other in shared if table.get(other) is not None}
