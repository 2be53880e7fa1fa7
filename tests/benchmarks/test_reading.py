"""The benchmark of reading says rates beside raw reading."""

from pathlib import Path

from benchmarks.reading import ReadingSettings, measure
from tests.support.fabricate import fabricate_store


def test_each_way_of_reading_is_measured_beside_raw_reading(tmp_path: Path) -> None:
    store = fabricate_store(tmp_path / "store", 3)
    result = measure(ReadingSettings(store=store.where, repeats=1))
    assert (result["shards"], result["interactions"]) == (3, 6)
    assert list(result["read"]) == ["table, 5 columns", "clouds", "samples with clouds"]
    for figures in result["read"].values():
        assert min(figures.values()) > 0
