"""Trusses from tables: determinate ones are staged, wrong ones refused with the motion or member named."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from modules import double_octahedral, graph_truss, hexapod, longeron, octahedral

from vgtm_qp.arm.truss.determinacy import check_determinacy, length_jacobian
from vgtm_qp.arm.truss.mobility import describe
from vgtm_qp.arm.truss.stages import placement_stages
from vgtm_qp.errors import ProblemError, TrussError

CMU = json.loads((Path(__file__).parent / "data" / "cmu_truss.json").read_text())


def tables(truss, *, without=(), extra=()):
    """Return the keywords of `graph_truss` for a truss less some members and with some more."""
    nodes = [
        {"name": name, "position": truss.home[i].tolist(), "fixed": bool(truss.base[i])}
        for i, name in enumerate(truss.node_names)
    ]
    members = [
        {
            "name": name,
            "nodes": [truss.node_names[i] for i in truss.members[k]],
            "actuated": bool(truss.actuated[k]),
        }
        for k, name in enumerate(truss.member_names)
        if name not in without
    ]
    return {
        "nodes": nodes,
        "members": [*members, *({"name": name, "nodes": list(ends)} for name, ends in extra)],
        "tip": [truss.node_names[i] for i in truss.tip],
        "faces": [[truss.node_names[i] for i in face] for face in truss.faces],
        "stroke": [0.5, 1.6],
    }


def test_cmu_truss_is_determinate_and_placed_node_by_node():
    truss = graph_truss(**CMU)
    assert (truss.node_count, truss.member_count, int(truss.actuated.sum())) == (17, 42, 42)
    assert check_determinacy(truss).rank == 42
    np.testing.assert_array_equal(truss.stage, [-1, -1, -1, *range(14)])
    np.testing.assert_array_equal(truss.stroke, np.tile([9.0, 11.0], (42, 1)))
    assert ((truss.home_lengths >= 9.0) & (truss.home_lengths <= 11.0)).all()
    assert truss.tip.tolist() == [16]
    description = describe(truss)
    assert (description.tip_rank, description.tip_coordinates, description.free_motions) == (3, 3, 42)


@pytest.mark.parametrize("build", [octahedral, double_octahedral, hexapod, longeron])
def test_a_module_given_as_a_graph_is_staged_face_by_face(build):
    truss = build(4)
    graph = graph_truss(**tables(truss))
    order = [graph.node_names.index(name) for name in truss.node_names]
    for layer in range(1, truss.stage.max() + 2):
        nodes = graph.stage[order][3 * layer : 3 * layer + 3]
        before = graph.stage[order][: 3 * layer]
        assert nodes.min() > before.max()
    np.testing.assert_allclose(graph.face_frames[:, :, 2], np.tile([0.0, 0.0, 1.0], (5, 1)), atol=1e-12)
    toward = truss.home[truss.faces[:, 0]] - truss.home[truss.faces].mean(axis=1)
    np.testing.assert_allclose(
        graph.face_frames[:, :, 0], toward / np.linalg.norm(toward, axis=1, keepdims=True), atol=1e-12
    )
    np.testing.assert_allclose(graph.tip_frame, graph.face_frames[-1])
    assert graph.trackable == ("position", "pointing", "orientation")[: 3 if build is hexapod else 1]


def test_mechanism_is_refused_with_the_free_node_named():
    with pytest.raises(TrussError) as caught:
        graph_truss(**tables(octahedral(2), without=["B2-1"]))
    message = str(caught.value)
    assert "17 members for 18 unknown coordinates" in message
    assert "1 free motion" in message
    assert "node n2-" in message
    assert "node n1-" not in message


def test_free_motion_names_the_direction():
    nodes = [
        {"name": "a", "position": [1.0, 0.0, 0.0], "fixed": True},
        {"name": "b", "position": [-1.0, 0.0, 0.0], "fixed": True},
        {"name": "c", "position": [0.0, 1.0, 0.0], "fixed": True},
        {"name": "top", "position": [0.0, 0.0, 0.0]},
    ]
    members = [{"name": f"m{x}", "nodes": [x, "top"]} for x in "abc"]
    with pytest.raises(TrussError, match=r"node top along \((0, 0, 1|0, 0, -1)\)") as caught:
        graph_truss(nodes, members, ["top"])
    assert "among ma, mb" in str(caught.value)
    assert "mc" not in str(caught.value)


def test_overbraced_truss_is_refused_with_the_self_stress_named():
    extra = [("X", ("n1-1", "n0-3"))]
    with pytest.raises(TrussError) as caught:
        graph_truss(**tables(octahedral(2), extra=extra))
    message = str(caught.value)
    assert "19 members for 18 unknown coordinates" in message
    assert "1 redundant member" in message
    assert "X" in message.split("among")[1]
    assert not any(f"{kind}2-" in message for kind in "BL")
    assert "free motion(s)" not in message


def test_right_count_with_mechanism_and_self_stress_names_both():
    arm = octahedral(3)
    with pytest.raises(TrussError) as caught:
        graph_truss(**tables(arm, without=["B3-1"], extra=[("X", ("n1-1", "n0-3"))]))
    message = str(caught.value)
    assert "27 members for 27 unknown coordinates" in message
    assert "node n3-" in message
    assert "X" in message.split("among")[1]


def test_of_two_free_motions_the_more_local_one_is_named():
    with pytest.raises(TrussError, match=r"2 free motion\(s\)") as caught:
        graph_truss(**tables(octahedral(3), without=["B1-1", "B3-1"]))
    message = str(caught.value)
    assert "node n3-" in message
    assert "node n1-" not in message
    assert "node n2-" not in message


def test_of_two_redundant_members_one_self_stress_is_named():
    extra = [("X", ("n0-1", "n0-2")), ("Y", ("n1-1", "n0-3"))]
    with pytest.raises(TrussError, match=r"2 redundant member\(s\), one of them among X: it has to go"):
        graph_truss(**tables(octahedral(3), extra=extra))


def test_member_between_base_nodes_is_redundant():
    with pytest.raises(TrussError, match=r"among X: it has to go"):
        graph_truss(**tables(octahedral(2), extra=[("X", ("n0-1", "n0-2"))]))


@pytest.mark.parametrize("bays", [10, 55])
def test_wrong_truss_is_named_whatever_its_size(bays):
    arm = octahedral(bays)
    keep = np.array([name != f"B{bays}-2" for name in arm.member_names])
    names = tuple(name for name, kept in zip(arm.member_names, keep, strict=True) if kept)
    cut = dataclasses.replace(arm, members=arm.members[keep], member_names=names)
    with pytest.raises(TrussError, match=f"node n{bays}-") as caught:
        check_determinacy(cut)
    assert f"node n{bays - 1}-" not in str(caught.value)


@pytest.mark.parametrize("bays", [40, 60])
def test_sparse_and_dense_singular_values_agree(bays):
    truss = hexapod(bays)
    report = check_determinacy(truss)
    values = np.linalg.svd(length_jacobian(truss).toarray(), compute_uv=False)
    assert report.smallest_singular_value == pytest.approx(values[-1], rel=1e-6)
    assert report.condition == pytest.approx(values[0] / values[-1], rel=1e-3)


@pytest.mark.parametrize("module", [octahedral, longeron])
def test_pin_jacobian_is_the_derivative_of_the_lengths(module, rng):
    truss = module(3)
    X = truss.home + 0.1 * rng.standard_normal(truss.home.shape)
    direction = rng.standard_normal(3 * len(truss.free))
    difference = np.zeros(truss.member_count)
    for sign in (1.0, -1.0):
        moved = X.copy()
        moved[truss.free] += sign * 1e-6 * direction.reshape(-1, 3)
        lengths = np.linalg.norm(moved[truss.members[:, 0]] - moved[truss.members[:, 1]], axis=1)
        difference += sign * lengths / 2e-6
    np.testing.assert_allclose(length_jacobian(truss, X) @ direction, difference, atol=1e-8)


def test_nodes_that_hang_on_nothing_are_named():
    spec = tables(octahedral(1))
    spec["nodes"].append({"name": "alone", "position": [5.0, 0.0, 0.0]})
    with pytest.raises(TrussError, match=r"joins node\(s\) alone to the base"):
        graph_truss(**spec)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s["members"][0].update(nodes=["n1-1", "n0-9"]), "n0-"),
        (lambda s: s["members"][0].update(nodes=["n1-1", "n1-1"]), "two different nodes"),
        (lambda s: s["members"][1].update(nodes=s["members"][0]["nodes"]), "L1-1"),
        (lambda s: s["nodes"][4].update(position=s["nodes"][3]["position"]), "further apart"),
        (lambda s: s.update(tip=["n1-7"]), "n1-"),
    ],
)
def test_contradicting_tables_are_refused(change, message):
    spec = tables(octahedral(1))
    change(spec)
    with pytest.raises(ProblemError, match=message):
        graph_truss(**spec)


def test_actuated_members_need_a_stroke():
    spec = tables(octahedral(1))
    del spec["stroke"]
    with pytest.raises(TrussError, match="B1-1 has no stroke"):
        graph_truss(**spec)


def test_rounded_positions_are_corrected_to_given_lengths():
    spec = tables(octahedral(3))
    for node in spec["nodes"]:
        node["position"] = np.round(node["position"], 4).tolist()
    for member in spec["members"]:
        member["length"] = 1.0
    truss = graph_truss(**spec)
    np.testing.assert_allclose(truss.home_lengths, 1.0, atol=1e-12)
    spec["members"][0]["length"] = 1.2
    with pytest.raises(TrussError, match=r"has the length 1\.2 m, but"):
        graph_truss(**spec)


def test_line_of_tip_nodes_has_no_frame():
    spec = tables(octahedral(2))
    for name, x in (("p", 0.1), ("q", 0.2), ("r", 0.3)):
        spec["nodes"].append({"name": name, "position": [x, 0.0, 3.0]})
        spec["members"] += [{"name": f"{name}{k}", "nodes": [name, f"n2-{k}"]} for k in (1, 2, 3)]
    with pytest.raises(TrussError, match="p, q, r lie on one line"):
        graph_truss(**spec | {"tip": ["p", "q", "r"]})


def test_tip_nodes_are_put_in_order_around_their_polygon():
    spec = tables(hexapod(1))
    corners = {"p": (0.4, 0.4), "q": (-0.4, -0.4), "r": (0.4, -0.4), "s": (-0.4, 0.4)}
    for name, (x, y) in corners.items():
        spec["nodes"].append({"name": name, "position": [x, y, 1.5]})
        spec["members"] += [{"name": f"{name}{k}", "nodes": [name, f"n1-{k}"]} for k in (1, 2, 3)]
    truss = graph_truss(**spec | {"tip": list(corners)})
    assert [truss.node_names[i] for i in truss.tip] == ["p", "s", "q", "r"]
    np.testing.assert_allclose(truss.tip_frame[:, 2], [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(truss.tip_frame[:, 0], np.array([1.0, 1.0, 0.0]) / np.sqrt(2), atol=1e-12)


def test_offsets_of_a_graph_match_those_of_the_module(rng):
    arm = octahedral(2, joint_offset=0.1)
    spec = tables(arm)
    graph = graph_truss(**spec, joint_offset=0.1)
    np.testing.assert_allclose(graph.home_lengths, arm.home_lengths)
    for i, node in enumerate(spec["nodes"]):
        node["joint"] = [arm.node_names[j] for j in arm.joints.triangle[i, 1:]]
    for k, member in enumerate(spec["members"]):
        member["offsets"] = arm.joints.offset[k].tolist()
    explicit = graph_truss(**spec)
    np.testing.assert_array_equal(explicit.joints.triangle, arm.joints.triangle)
    X = arm.home + 0.05 * rng.standard_normal(arm.home.shape)
    np.testing.assert_allclose(
        length_jacobian(explicit, X).toarray(),
        length_jacobian(arm, X).toarray()[
            :, np.argsort(np.repeat(3 * arm.free, 3) + np.tile(range(3), len(arm.free)))
        ][:, np.argsort(np.argsort(np.repeat(3 * explicit.free, 3) + np.tile(range(3), len(explicit.free))))],
        atol=1e-12,
    )


@st.composite
def hung_trusses(draw):
    """Trusses grown by hanging each node on three placed ones, with shuffled names and members."""
    count = draw(st.integers(1, 12))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    positions = [np.array(p) for p in ([1.0, 0.0, 0.0], [-0.5, 0.9, 0.0], [-0.5, -0.9, 0.0])]
    hung = []
    for i in range(3, 3 + count):
        while True:
            feet = sorted(int(j) for j in rng.choice(i, 3, replace=False))
            point = np.mean([positions[j] for j in feet], axis=0) + rng.standard_normal(3)
            legs = np.array([(point - positions[j]) / np.linalg.norm(point - positions[j]) for j in feet])
            if abs(np.linalg.det(legs)) > 0.2:
                break
        positions.append(point)
        hung += [(i, j) for j in feet]
    order = rng.permutation(len(positions))
    nodes = [{"name": f"n{i}", "position": positions[i].tolist(), "fixed": bool(i < 3)} for i in order]
    members = [
        {"name": f"m{i}-{j}", "nodes": [f"n{i}", f"n{j}"][:: int(rng.choice([1, -1]))]}
        for i, j in (hung[k] for k in rng.permutation(len(hung)))
    ]
    return nodes, members, f"n{2 + count}"


@settings(max_examples=40, deadline=None)
@given(hung_trusses())
def test_hung_trusses_are_determinate_and_placed_one_node_at_a_time(spec):
    nodes, members, tip = spec
    truss = graph_truss(nodes, members, [tip])
    assert sorted(truss.stage[~truss.base]) == list(range(len(nodes) - 3))
    later = truss.stage[truss.members].max(axis=1)
    assert (np.bincount(later) == 3).all()
    for name, stage in zip(truss.node_names, truss.stage, strict=True):
        owned = [k for k in range(truss.member_count) if later[k] == stage]
        assert stage < 0 or all(truss.member_names[k].startswith(f"m{name[1:]}-") for k in owned)


@settings(max_examples=25, deadline=None)
@given(hung_trusses(), st.data())
def test_cut_and_braced_trusses_are_refused(spec, data):
    nodes, members, tip = spec
    cut = data.draw(st.integers(0, len(members) - 1))
    with pytest.raises(TrussError, match=r"1 free motion\(s\)|no chain of members"):
        graph_truss(nodes, members[:cut] + members[cut + 1 :], [tip])
    joined = {frozenset(member["nodes"]) for member in members}
    base = {node["name"] for node in nodes if node["fixed"]}
    pairs = [
        (a["name"], b["name"])
        for i, a in enumerate(nodes)
        for b in nodes[:i]
        if frozenset((a["name"], b["name"])) not in joined and not {a["name"], b["name"]} <= base
    ]
    if pairs:
        brace = {"name": "brace", "nodes": list(data.draw(st.sampled_from(pairs)))}
        with pytest.raises(TrussError, match=r"1 redundant member\(s\)"):
            graph_truss(nodes, [*members, brace], [tip])


def test_stages_refuse_members_that_cannot_be_shared_out():
    base = np.array([True, True, True, False, False])
    members = np.array([[3, 0], [3, 1], [3, 2], [4, 3], [4, 0], [0, 1]])
    with pytest.raises(TrussError, match="three to each free node"):
        placement_stages(base, members)
