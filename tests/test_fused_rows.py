"""The condensed QP from one compiled call, and the linearisation, against plain equations at random configurations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import oracle
import pytest
from arms import TRUSSES
from steps import SHAPES, asked_at_random, curved

from vgtm_qp.compiled import compiler
from vgtm_qp.native import Code, building
from vgtm_qp.problem.method import Weights
from vgtm_qp.qp.fused import FusedSolver
from vgtm_qp.qp.fused_rows import RESULTS
from vgtm_qp.qp.linearise import Linearisation
from vgtm_qp.rows.curve import free_basis

FRAMED = [name for name in TRUSSES if name != "graph"]
TRACKS = [("position",), ("y",), ("x", "z"), ("z", "orientation"), ("orientation",)]
CURVES = ["tables", "none", "hard", "hard turns", *SHAPES, "hard torsion", "drawn"]


pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")


def compare(layout, seeds=range(1)):
    """Compare both forms of the QP with the equations."""
    assert building().finish() is not None
    linearisation, solver = Linearisation(layout, compiled=False), FusedSolver(layout, compiled=False)
    assert solver.is_ready
    for seed in seeds:
        for motion, progress, base in ((True, 0.0, False), (True, 0.3, True), (False, 0.7, True)):
            asked, rows = asked_at_random(layout, seed, base=base, progress=progress, motion=motion)
            given = oracle.numbers(layout, asked)
            oracle.check_numbers(linearisation.numbers(asked, rows), given, layout, 1e-11)
            wanted = oracle.condensed(layout, asked, given)
            solver.load(asked)
            work = solver.workspace
            assert work.call("assemble") is Code.DONE
            results = dict(zip(RESULTS, (output.copy() for output in work.condense.outputs), strict=False))
            legs, least = results["leg_rows"], results["leg_lower"]
            numbers = linearisation.numbers(asked, rows)
            basis = free_basis(results["normal"], 3 * layout.vertices + layout.torsion)
            of_legs = np.pad(numbers.legs.rows, ((0, 0), (0, layout.torsion)))
            np.testing.assert_allclose(
                legs.reshape(len(least), layout.free_curve), of_legs @ basis, atol=1e-12
            )
            np.testing.assert_allclose(least, numbers.legs.lower, atol=1e-12)
            tips, bounds = len(layout.tip_rows), work.size + len(layout.tip_rows)
            found = {name: results[name] for name in ("curvature", "offset", "normal")}
            found |= {"rows": work.stack.T, "tip": work.constraint[:tips], "gradient": results["linear"]}
            found |= {"lower": work.lower[:bounds], "upper": work.upper[:bounds]}
            # A response is as large as the pose is near to a singular one.
            scale = 1.0 + float(np.abs(wanted["rows"]).max())
            for name, value in wanted.items():
                bounded = np.abs(value) < 1e29
                got = found[name].reshape(value.shape)
                np.testing.assert_array_equal(np.abs(got) < 1e29, bounded, err_msg=name)
                np.testing.assert_allclose(
                    got[bounded], value[bounded], rtol=0.0, atol=1e-11 * scale, err_msg=name
                )


@pytest.mark.parametrize("joint_offset", [0.0, 0.1])
@pytest.mark.parametrize("name", FRAMED)
def test_every_module_and_joint(name, joint_offset):
    compare(curved(TRUSSES[name](joint_offset=joint_offset), ("position", "pointing")), range(3))


@pytest.mark.parametrize("track", TRACKS, ids="+".join)
def test_every_coordinate_of_a_tip(track):
    compare(curved(TRUSSES["hexapod"](), track), range(2))


@pytest.mark.parametrize("family", ["bezier", "b-spline", "beta-spline"])
@pytest.mark.parametrize("curve", CURVES)
def test_every_curve(curve, family):
    compare(curved(TRUSSES["hexapod"](), ("position",), curve, family))


@pytest.mark.parametrize("curve", ["hard", "everything", "drawn"])
@pytest.mark.parametrize("name", ["double-octahedral", "longeron", "tetrahedral-2", "tetrahedral-123"])
def test_other_modules_with_other_curves(name, curve):
    compare(curved(TRUSSES[name](joint_offset=0.05), ("position", "pointing"), curve))


def test_every_weight_counts_where_it_should(rng):
    names = Weights.model_fields
    weights = Weights(**dict(zip(names, rng.uniform(0.2, 3.0, len(names)).tolist(), strict=True)))
    layout = curved(TRUSSES["hexapod"](), ("position", "orientation"), "everything")
    compare(replace(layout, weights=weights))


@pytest.mark.parametrize("compiled", [False, True])
def test_numbers_are_arrays_of_their_own(compiled):
    layout = curved(TRUSSES["octahedral"](), ("position",))
    linearisation = Linearisation(layout, compiled=compiled)
    (first, rows), (second, _) = (
        asked_at_random(layout, seed, base=False, progress=0.0, motion=True) for seed in range(2)
    )
    kept = linearisation.numbers(first, rows)
    linearisation.numbers(second, rows)
    oracle.check_numbers(kept, oracle.numbers(layout, first), layout)
