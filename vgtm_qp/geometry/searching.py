"""What C knows of hulls and of the pairs of a shape, and its search for the nearest points of pairs with hulls."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache

import casadi as ca
import numpy as np

from vgtm_qp.arrays import Array, Index, Mask
from vgtm_qp.compiled import Compiling, Kernel, compiler
from vgtm_qp.errors import EvaluationError
from vgtm_qp.geometry.bodies import Bodies
from vgtm_qp.geometry.exact import SECOND_CONTACT, follow_function, support_function, turning_function
from vgtm_qp.geometry.formulas import PARALLEL
from vgtm_qp.native import Code, Program, building

Make = Callable[[str], ca.Function]


@cache
def compiling(make: Make, shape: str, _: str | None) -> tuple[ca.Function, Compiling]:
    """Return a function of :mod:`vgtm_qp.geometry.exact`, and its compilation, once for each compiler."""
    function = make(shape)
    return function, Compiling(function)


def kernel(make: Make, shape: str) -> Kernel:
    """Return a function of :mod:`vgtm_qp.geometry.exact` for C."""
    function, own = compiling(make, shape, compiler())
    return Kernel(function, compiled=own)


def _makers(shape: str, has_hulls: bool) -> Iterator[tuple[str, Make]]:
    """Yield by their names in C what makes the functions of pairs."""
    yield "contact", follow_function
    if has_hulls:
        yield "turning", turning_function
    if has_hulls and shape != "segment":
        yield "furthest", support_function


def is_ready(shapes: Sequence[str], *, has_hulls: bool) -> bool:
    """Whether C is there for pairs of these shapes; always false if nothing can be compiled."""
    library = building()
    if not library.ask():
        for shape in shapes:
            for _, make in _makers(shape, has_hulls):
                compiling(make, shape, compiler())[1].ask()
    return library.library is not None


def pairs_of(shape: str, *, has_hulls: bool) -> Program:
    """Return the ``Pairs`` of C of one shape, with its functions alone."""
    program, contact = Program("Pairs"), kernel(follow_function, shape)
    others = {name: kernel(make, shape) for name, make in _makers(shape, has_hulls) if name != "contact"}
    program.set(
        is_self=int(shape == "segment"),
        contact=contact,
        ends=contact.inputs[0],
        pair=contact.inputs[1],
        found=contact.outputs[0],
        **others,
    )
    return program


def hulls_of(bodies: Bodies, unit: float) -> Program:
    """Return the ``Hulls`` of C of an arm's bodies; `unit` is that of the tolerances of its answers, m."""
    every = np.arange(len(bodies))
    program = Program("Hulls")
    program.set(
        vertices_at=np.cumsum([0, *bodies.counts], dtype=np.int32),
        vertices=np.concatenate([bodies.weights_of(every[k : k + 1])[0] for k in every.tolist()]),
        sizes=bodies.sizes,
        unit=unit,
        parallel=PARALLEL,
        aside=SECOND_CONTACT,
    )
    return program


class Search:
    """Finds the nearest points of pairs of one shape with hulls; one thread at a time."""

    def __init__(self, bodies: Bodies, unit: float, shape: str) -> None:
        self._pairs, self._hulls = pairs_of(shape, has_hulls=True), hulls_of(bodies, unit)
        self._program = Program("Search")
        self._program.set(pairs=self._pairs.address, hulls=self._hulls.address)

    def __call__(self, body: Index, other: Index, numbers: Array) -> tuple[Array, Array, Array, Mask]:
        """Return nearest points (k, 3) of bodies (k,) and others (k,), m, normals (k, 3), and which are apart (k,).

        The `numbers` (k, 24 or more) are the points that span the body, then those of the other, or the piece.
        """
        nearest, is_apart = np.zeros((len(body), 9)), np.zeros(len(body), dtype=np.int32)
        self._pairs.refresh()
        self._program.set(
            count=len(body),
            width=numbers.shape[1],
            body=body.astype(np.int32),
            other=other.astype(np.int32),
            numbers=np.ascontiguousarray(numbers),
            nearest=nearest,
            is_apart=is_apart,
        )
        if self._program.call("search") is not Code.DONE:
            raise EvaluationError("the distance of a pair has no value")
        return nearest[:, :3], nearest[:, 3:6], nearest[:, 6:], is_apart > 0
