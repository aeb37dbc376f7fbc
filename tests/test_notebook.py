"""What notebooks show of problems, steps, maneuvers and verdicts, and the table of a maneuver's states."""

from __future__ import annotations

from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from arms import arm_problem

import vgtm_qp as vq


@pytest.fixture(autouse=True)
def _without_a_compiler(monkeypatch):
    monkeypatch.setenv("VGTM_CC", "none")


@pytest.fixture(scope="module")
def maneuver():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VGTM_CC", "none")
        return vq.solve(arm_problem(name="<an arm>", steps=4))


class Words(HTMLParser):
    """The words of a page, and whether each of its elements is closed."""

    def __init__(self, page):
        super().__init__()
        self.open, self.words = [], []
        self.feed(page)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def test_objects_show_themselves_as_tables(maneuver):
    problem = arm_problem(name="<an arm>", steps=4)
    resolver = vq.Resolver(problem)
    step = resolver.step(position=resolver.tip()[0] + [0.01, 0.0, 0.0], dt=0.1)
    verdict = vq.certify(problem, maneuver.time, maneuver.actuator_values)
    shown = {
        problem: ["<an arm>", "octahedral", "bezier"],
        step: ["reached", "100 %"],
        maneuver: ["<an arm>: solved", "tip error"],
        maneuver.certificate: ["verified", "clearance between"],
        verdict: ["certified"],
    }
    for one, texts in shown.items():
        words = " ".join(Words(one._repr_html_()).words)
        assert all(text in words for text in texts), words


def test_what_failed_is_red(maneuver):
    nodes = maneuver.nodes.copy()
    nodes[-1, -1] += 1e-3
    page = replace(maneuver, nodes=nodes)
    found = vq.verify(page)
    assert "color" in found._repr_html_()
    assert "VERIFICATION FAILED" in found._repr_html_()
    assert "color" not in maneuver.certificate._repr_html_()


def test_a_table_of_pandas_has_a_row_for_each_state(maneuver):
    pytest.importorskip("pandas")
    table = maneuver.to_dataframe()
    np.testing.assert_array_equal(table.index, maneuver.time)
    np.testing.assert_array_equal(table[list(maneuver.actuator_names)], maneuver.actuator_values)
    np.testing.assert_array_equal(table[["tip x", "tip y", "tip z"]], maneuver.tip_position)
    np.testing.assert_array_equal(table["clearance"], maneuver.clearance)


def test_without_pandas_the_extra_is_named(maneuver, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(vq.MissingExtraError, match=r"vgtm-qp\[pandas\]"):
        maneuver.to_dataframe()
