"""``vgtm schema``: the JSON Schema of problem files."""

from __future__ import annotations

from vgtm_qp.cli.output import Json, document


def schema(*, json: Json = False) -> None:  # noqa: ARG001 - the answer is one JSON document either way
    """Print the JSON Schema of problem files, for editors that complete and check TOML."""
    from vgtm_qp.problem import problem_schema

    document(problem_schema())
