"""How far points of a serial arm leave their straight chords while its joints move linearly.

A point that moves with acceleration p'' per share of the motion leaves its chord by at most an eighth of the greatest
|p''|. The point is a sum of vectors, each fixed in the frame of a joint, which turns at w: a vector v has
v'' = w' x v + w x (w x v).
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from vgtm_qp.arm.serial.chain import SerialChain
from vgtm_qp.arm.symbols import Bound, Constants, rotated
from vgtm_qp.arrays import Array


def bend_function(chain: SerialChain) -> Bound:
    """Return the function of bounds of |p''| over the straight motion between two configurations.

    Arguments: configurations (J + 6), start and end. Result (3): bounds for all nodes, m; for the tip, m; and for a
    point fixed to the tip, per distance from it.

    Speeds w and accelerations w' are computed at the middle of the motion and bounded from there: in joints that turn
    to and fro they cancel, where the sums of all turns would be many times greater. A base that turns has no such
    values; then these sums are the bounds.
    """
    count, constants = len(chain), Constants()
    start, end = ca.MX.sym("start", count + 6), ca.MX.sym("end", count + 6)
    axes, rotations = (constants.add(name, chain.constants[name]) for name in ("axes", "rotations"))
    lengths = constants.add("lengths", np.append(chain.lengths, 0.0))
    turns = constants.add("turns", chain.revolute.astype(float))
    furthest = constants.add("furthest", _furthest(chain))
    change = end - start
    # A rotation vector counts twice, as its axis turns too.
    base = 2.0 * ca.norm_2(change[count + 3 :])
    unknown = ca.if_else(base > 0.0, ca.inf, 0.0)
    state = ca.vertcat(
        ca.DM.eye(3).reshape((9, 1)), ca.DM.zeros(7), base, base**2, 0.0, base**2 * furthest[0]
    )
    middle = (start + 0.5 * change)[:count]
    rows = [middle.T, change[:count].T, axes, ca.reshape(rotations, 9, count), turns.T]
    rows += [lengths[:count].T, furthest[1:].T, ca.repmat(unknown, 1, count)]
    states = _joint().mapaccum("bends", count)(state, *rows)
    last = states[:, -1]
    tip = last[_BENT] + last[_BEND] * lengths[count]
    return constants.bound("bend", [start, end], [ca.vertcat(ca.fmax(last[_WORST], tip), tip, last[_BEND])])


_FRAME, _SPEED, _RATE = slice(0, 9), slice(9, 12), slice(12, 15)
_GROWTH, _TURNED, _BEND, _BENT, _WORST = range(15, 20)
"""Places of a joint's state: its frame, its speed w and its w' at the middle; bounds of |w''|, and of the sum of all
turns; of |v''| per length of v; of |p''| at its origin, and at all nodes up to there."""


def _furthest(chain: SerialChain) -> Array:
    """Return (J + 1,) the greatest distances of nodes and bodies from the origins of their frames, m."""
    found = np.full(len(chain) + 1, chain.spread)
    np.maximum.at(found, chain.carriers, chain.beyond)
    return found


def _joint() -> ca.Function:
    """Return the function from the state before a joint to that after it.

    Its other arguments are the joint's value at the middle, its change, axis and rotation, whether it turns, its
    distance from the joint before, the furthest node that it carries, and zero, or infinity if the base turns.
    """
    state, value, change = ca.SX.sym("state", 20), ca.SX.sym("value"), ca.SX.sym("change")
    axis, rotation, turns = ca.SX.sym("axis", 3), ca.SX.sym("rotation", 9), ca.SX.sym("turns")
    length, furthest, unknown = ca.SX.sym("length"), ca.SX.sym("furthest"), ca.SX.sym("unknown")
    bent = state[_BENT] + state[_BEND] * length
    frame = ca.reshape(state[_FRAME], 3, 3) @ ca.reshape(rotation, 3, 3)
    along, turn = frame @ axis, turns * change
    speed = state[_SPEED] + turn * along
    rate = state[_RATE] + turn * ca.cross(state[_SPEED], along)
    turned = state[_TURNED] + ca.fabs(turn)
    # |w''| grows by the acceleration of each axis, times its turn.
    growth = state[_GROWTH] + ca.fabs(turn) * state[_BEND]
    faster = ca.fmin(ca.norm_2(rate) + 0.5 * growth + unknown, 0.5 * turned**2)
    fast = ca.fmin(ca.norm_2(speed) + 0.5 * faster + unknown, turned)
    bend = ca.fmin(faster + fast**2, turned**2)
    # A slide moves its vector along itself, too.
    slide = (1.0 - turns) * ca.fabs(change)
    bent += 2.0 * slide * fast + (1.0 - turns) * (ca.fabs(value) + 0.5 * slide) * bend
    frame = frame @ rotated(turns * value * axis)
    worst = ca.fmax(state[_WORST], bent + bend * furthest)
    after = ca.vertcat(ca.vec(frame), speed, rate, growth, turned, bend, bent, worst)
    arguments = [state, value, change, axis, rotation, turns, length, furthest, unknown]
    return ca.Function("joint", arguments, [ca.densify(after)])
