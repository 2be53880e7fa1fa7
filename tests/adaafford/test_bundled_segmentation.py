"""The bundled segmentation network: small, described, and of use on a scan that it was not trained on."""

from pathlib import Path

import numpy as np
import pytest

from adaafford.parts import SEGMENTATION, bundled_segmenter, read_segmenter
from adaafford.pretrained import PRETRAINED_FOLDER
from collector.objects.catalogue import load, scan
from collector.objects.procedural.catalogue import generate
from collector.scenes import random_scan
from shared.seeds import generator
from shared.segmentation.scenes import Kind
from shared.segmentation.segmenter import Segmenter


def test_the_bundled_network_is_small_and_has_a_card() -> None:
    folder = PRETRAINED_FOLDER / SEGMENTATION
    assert sum(path.stat().st_size for path in folder.iterdir()) < 1 << 20
    assert "Limits" in (folder / "README.md").read_text()
    assert isinstance(read_segmenter(folder), Segmenter)


@pytest.mark.slow
def test_it_finds_an_unseen_object_among_other_things(tmp_path: Path) -> None:
    generate(tmp_path, {"StorageFurniture": 1}, 901)
    target = load(scan(tmp_path).usable[0])
    seen = random_scan(target, (0.5, 0.5), generator(2, "test"))
    found = bundled_segmenter().segment(seen.image.points, seen.world_from_camera[:3, 3])
    guessed = np.zeros(len(seen.kinds), dtype=bool)
    guessed[found.object] = True
    of_object = seen.kinds != Kind.BACKGROUND
    assert (guessed & of_object).sum() > 0.8 * (guessed | of_object).sum()
    assert found.parts
