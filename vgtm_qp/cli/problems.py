"""``vgtm check``, ``vgtm list``, ``vgtm schema``: problem files, without solving any."""

from __future__ import annotations

from vgtm_qp.cli.output import Json, ProblemName, answer, document, note, table, waiting


def check(problem: ProblemName, /, *, json: Json = False) -> None:
    """Check a problem file: its keys and values, its arm, its obstacles and goals at the home pose."""
    from dataclasses import asdict

    from vgtm_qp.methods import Resolver
    from vgtm_qp.problem import load_problem
    from vgtm_qp.step.build import build_arm
    from vgtm_qp.step.checks import check_problem, find_warnings

    loaded = load_problem(problem)
    source = str(loaded.source or loaded.name)
    with waiting(f"{loaded.name}: checking", shown=not json):
        setup = build_arm(loaded)
        mistakes = check_problem(loaded, setup)
        if mistakes:
            raise loaded.error(mistakes)
        if loaded.method.name != "qp":
            # Other methods have further requirements of an arm.
            Resolver(loaded)
        warnings = find_warnings(loaded, setup)
    for warning in warnings:
        note(f"{source}: warning: {warning}")
    arm, tip, bodies = setup.arm.describe(), setup.arm.end_effector, setup.arm.bodies
    position = (tip.position(setup.arm.home).round(12) + 0.0).tolist()
    touching = [[bodies.names[a], bodies.names[b]] for a, b in bodies.touching.tolist()]
    found = {
        "file": source,
        "name": loaded.name,
        "valid": True,
        "warnings": [asdict(warning) for warning in warnings],
        "arm" if loaded.truss is None else "truss": asdict(arm),
        "tip_at_home": position,
        "touching_at_home": touching,
    }
    lines = [
        f"{source}: no mistakes",
        str(arm),
        f"tip at home: [{', '.join(f'{x:.6g}' for x in position)}] m",
    ]
    if touching:
        lines.append(
            f"touch at home and are not kept apart: {', '.join(' / '.join(pair) for pair in touching)}"
        )
    answer(found, "\n".join(lines), as_json=json)


def list_problems(*, json: Json = False) -> None:
    """List the bundled problems; `vgtm solve` and `vgtm check` take their names as well as files."""
    from vgtm_qp.problem import bundled_problems, load_problem

    entries = [
        {"name": name, "title": load_problem(file).name, "file": str(file)}
        for name, file in bundled_problems().items()
    ]
    titles = table([(entry["name"], entry["title"]) for entry in entries])
    answer({"problems": entries}, titles, as_json=json)


def schema(*, json: Json = False) -> None:  # noqa: ARG001 - the answer is one JSON document either way
    """Print the JSON Schema of problem files, for editors that complete and check TOML."""
    from vgtm_qp.problem import problem_schema

    document(problem_schema())
