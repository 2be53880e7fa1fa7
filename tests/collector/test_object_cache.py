"""The cache of objects: what is kept is read once, and what is kept stays within bounds."""

from pathlib import Path

import pytest

from collector.objects.catalogue import ObjectCache, mesh_bytes, scan
from collector.objects.procedural import generate


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("objects")
    generate(folder, {"Faucet": 3}, seed=1)
    return folder


def test_an_object_is_read_once(folder: Path) -> None:
    cache, refs = ObjectCache(folder), [entry.ref for entry in scan(folder).usable]
    first = [cache.load(ref, "hulls") for ref in refs]
    assert [target.ref for target in first] == refs
    assert all(cache.load(ref, "hulls") is target for ref, target in zip(refs, first, strict=True))


def test_what_was_unused_for_longest_makes_room(folder: Path) -> None:
    a, b, c = (entry.ref for entry in scan(folder).usable)
    sizes = {ref.id: mesh_bytes(ObjectCache(folder).load(ref, "hulls")) for ref in (a, b, c)}
    cache = ObjectCache(folder, most_bytes=sum(sizes.values()) - 1)
    first, second = cache.load(a, "hulls"), cache.load(b, "hulls")
    assert cache.load(a, "hulls") is first
    cache.load(c, "hulls")
    assert cache.load(a, "hulls") is first
    assert cache.load(b, "hulls") is not second


def test_an_object_larger_than_the_cache_is_kept_alone(folder: Path) -> None:
    a, b = [entry.ref for entry in scan(folder).usable][:2]
    cache = ObjectCache(folder, most_bytes=1)
    first = cache.load(a, "hulls")
    assert cache.load(a, "hulls") is first
    cache.load(b, "hulls")
    assert cache.load(a, "hulls") is not first
