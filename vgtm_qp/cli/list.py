"""``vgtm list``: the problems that come with the package."""

from __future__ import annotations

from vgtm_qp.cli.output import Json, document, say, table


def list_problems(*, json: Json = False) -> None:
    """List the bundled problems; `vgtm solve` and `vgtm check` take their names as well as files."""
    from vgtm_qp.problem import bundled_problems, load_problem

    entries = [
        {"name": name, "title": load_problem(file).name, "file": str(file)}
        for name, file in bundled_problems().items()
    ]
    if json:
        document({"problems": entries})
    else:
        say(table([(entry["name"], entry["title"]) for entry in entries], indent=""))
