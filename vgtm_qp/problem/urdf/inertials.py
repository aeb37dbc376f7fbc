"""What links of a URDF weigh."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.problem.urdf.frames import Frame, Origins, after
from vgtm_qp.problem.urdf.text import Element, Mistakes

_MOMENTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


class Mass(NamedTuple):
    """A mass, kg, and its centre (3,), m."""

    mass: float
    centre: Array

    def __add__(self, other: object) -> Mass:
        """Return both together."""
        if not isinstance(other, Mass):
            return NotImplemented
        total = self.mass + other.mass
        if total == 0.0:
            return self
        return Mass(total, (self.mass * self.centre + other.mass * other.centre) / total)


WEIGHTLESS = Mass(0.0, np.zeros(3))


def mass_of(link: Element, what: str, frame: Frame, origins: Origins, mistakes: Mistakes) -> Mass:
    """Return what a link weighs, in the frame in which that of the link is given.

    Its moments of inertia, which do nothing at rest, are checked only. They may be zero, and so may the mass: in many
    files links that stand for frames have neither.
    """
    inertial = link.first("inertial")
    if inertial is None:
        return WEIGHTLESS
    what = f"{what}, <inertial>"
    centre = after(frame, origins.of(inertial, what))[0]
    given, moments = inertial.first("mass"), inertial.first("inertia")
    if given is None:
        mistakes.add(inertial, f"{what}, <mass>", None, "a mass, kg")
    if moments is not None:
        for key in _MOMENTS:
            default = (0.0,) if len(set(key[1:])) == 2 else None
            _number(moments, what, key, mistakes, default=default, signed=default is not None)
    return WEIGHTLESS if given is None else Mass(_number(given, what, "value", mistakes), centre)


def _number(
    element: Element,
    what: str,
    key: str,
    mistakes: Mistakes,
    *,
    default: tuple[float, ...] | None = None,
    signed: bool = False,
) -> float:
    """Return a number, which is 0 or more unless it is `signed`; 0 where it is wrong."""
    (value,) = mistakes.numbers(element, what, key, 1, default) or (0.0,)
    if value < 0.0 and not signed:
        mistakes.add(element, f"{what}, <{element.tag}> {key}", element.attributes[key], "0 or more")
    return value
