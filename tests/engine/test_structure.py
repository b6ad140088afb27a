"""Objects of the engine change by their own methods."""

from benchmarks.structure import foreign_assignments, rooms

MOST = 15


def test_few_assignments_go_to_attributes_of_other_objects() -> None:
    assert "engine" in rooms()
    assert 0 < foreign_assignments("engine") <= MOST
