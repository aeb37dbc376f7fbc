"""``vgtm bench``: the time of a step by phase, and what baselines take for the same steps in the same run."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

from vgtm_qp.cli.output import Json, Switch, answer, note

SceneKind = Literal["free", "cubes", "pointing", "clutter", "tetrahedral"]
TrackingName = Literal["elastic", "hard"]
BaselineName = Literal["eq28", "eq28-sparse", "curve", "ipopt", "osqp", "piqp"]

_several = partial(Switch, consume_multiple=True)


def bench(
    *,
    scene: Annotated[
        list[SceneKind] | None,
        _several(help="all of them, or cubes where --bays is given"),
    ] = None,
    bays: Annotated[
        list[int] | None,
        _several(
            validator=Number(gte=5, lte=10_000),
            help="of the arms between two cubes, 5 or more; 5 to 1000 by default",
        ),
    ] = None,
    tracking: Annotated[list[TrackingName] | None, _several(help="both by default")] = None,
    baselines: Annotated[
        list[BaselineName] | None,
        _several(negative="--no-baselines", help="what else takes the steps; all by default"),
    ] = None,
    seconds: Annotated[
        float, Parameter(validator=Number(gt=0), help="duration of each run of a scene, at most")
    ] = 2.0,
    steps: Annotated[int, Parameter(validator=Number(gte=1), help="steps of each run, at most")] = 1000,
    cold: Annotated[bool, Switch(help="set up with an empty cache of compiled kernels too")] = False,
    compare: Annotated[
        Path | None, Parameter(help="what --json printed before: give the ratios to it")
    ] = None,
    json: Json = False,
) -> None:
    """Measure how long a step takes, where that time goes, and what other methods take for the same steps.

    BLAS is held to one thread. Each scene is run by itself, for its median, percentiles and phases, then in
    turn with each baseline, step by step from the same states, for the ratios. Set-up and memory are those of
    a fresh process.
    """
    from vgtm_qp.machine import pin_threads

    pinned = pin_threads()
    from vgtm_qp.bench.contestants import NAMES
    from vgtm_qp.bench.report import compare as compared
    from vgtm_qp.bench.report import load_document, measure
    from vgtm_qp.bench.scenes import BAYS, KINDS, TRACKINGS, BenchScene, make_scenes
    from vgtm_qp.bench.tables import render

    older = None if compare is None else load_document(compare)
    kinds = scene or (("cubes",) if bays else KINDS)
    scenes = make_scenes(kinds, bays or BAYS, tracking or TRACKINGS)
    if not pinned:
        note("vgtm bench: BLAS was loaded before its threads could be held to one")

    def follow(under_way: BenchScene) -> None:
        note(f"{scenes.index(under_way) + 1}/{len(scenes)} {under_way.name}")

    found = measure(
        scenes,
        NAMES if baselines is None else tuple(dict.fromkeys(baselines)),
        seconds=seconds,
        steps=steps,
        cold=cold,
        pinned=pinned,
        progress=follow,
    )
    if older is not None:
        found["compared"] = compared(found, older)
    answer(found, render(found), as_json=json)
