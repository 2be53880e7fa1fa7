"""What all tests share: where real objects are, and one thread for every native library."""

import os

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    # Before any test module imports torch: small work on many threads is slower, and other processes want the cores.
    os.environ.setdefault(_name, "1")

from pathlib import Path  # noqa: E402

import pytest  # noqa: E402

OBJECTS_VARIABLE = "ADAAFFORD_OBJECTS"
BESIDE = Path(__file__).parents[2] / "shared" / "partnet_mobility"
"""Where real objects are looked for when the variable is unset: beside the checkout."""
if BESIDE.is_dir():
    os.environ.setdefault(OBJECTS_VARIABLE, str(BESIDE))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what needs real objects where there are none, and say why."""
    if os.environ.get(OBJECTS_VARIABLE):
        return
    reason = f"{OBJECTS_VARIABLE} names no folder of PartNet-Mobility objects, and {BESIDE} is not there"
    for item in items:
        if item.get_closest_marker("real_objects"):
            item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture(scope="session")
def real_objects() -> Path:
    """Folder of real objects, which tests must never write to."""
    return Path(os.environ[OBJECTS_VARIABLE])
