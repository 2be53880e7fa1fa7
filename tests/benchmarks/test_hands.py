"""The comparison of hands: what of which part held, on how many objects."""

import pytest

from benchmarks.hands import _figures, _grouped

SLIDES, TURNS = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0, 0.2, 0.0]


def test_rows_are_counted_by_category_and_kind_of_part() -> None:
    rows = [
        {"object_id": name, "object_category": category, "joint_twist": twist, "outcome": kind, "success": success}
        for name, category, twist, kind, success in (
            ("a", "Door", TURNS, "ok", True),
            ("a", "Door", TURNS, "no-grasp", False),
            ("b", "Table", SLIDES, "ok", False),
            ("c", "Table", TURNS, "start-collision", False),
        )
    ]
    groups = {name: _figures(of) for name, of in _grouped(rows).items()}
    assert set(groups) == {("all", "all"), ("all", "turns"), ("all", "slides"), ("Door", "turns")} | {
        ("Table", "slides"),
        ("Table", "turns"),
    }
    everything = groups["all", "all"]
    assert (everything["trials"], everything["objects"]) == (4, 3)
    assert (everything["success"], everything["held"]) == (0.25, 0.5)
    assert groups["Door", "turns"]["success_interval"] == pytest.approx((0.5, 0.5))
