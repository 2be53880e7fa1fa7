"""What all tests share: where real objects are, and one thread for every native library."""

import os

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    # Before any test module imports torch: small work on many threads is slower, and other processes want the cores.
    os.environ.setdefault(_name, "1")

import uuid  # noqa: E402
from collections.abc import Iterator  # noqa: E402
from pathlib import Path  # noqa: E402

import pytest  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

pytest.register_assert_rewrite("tests.support")

# Hypothesis' own limits of time fail where other processes keep the processors busy.
settings.register_profile("any-machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any-machine")

OBJECTS_VARIABLE = "ADAAFFORD_OBJECTS"
BESIDE = Path(__file__).parents[2] / "shared" / "partnet_mobility"
"""Where real objects are looked for when the variable is unset: beside the checkout."""
if BESIDE.is_dir():
    os.environ.setdefault(OBJECTS_VARIABLE, str(BESIDE))


SLOW_LIMIT_S = 900
"""For slow tests that name no limit of their own; on a busy machine the usual one cuts them off."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give slow tests time; skip what needs real objects where there are none, and say why."""
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(SLOW_LIMIT_S))
    if os.environ.get(OBJECTS_VARIABLE):
        return
    reason = f"{OBJECTS_VARIABLE} names no folder of PartNet-Mobility objects, and {BESIDE} is not there"
    for item in items:
        if item.get_closest_marker("real_objects"):
            item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture(scope="session", autouse=True)
def _no_waiting_for_the_disk() -> Iterator[None]:
    """No test cuts the power, and those of what is synced, and in which order, wrap or replace this once more."""

    def sync(descriptor: int) -> None:
        os.fstat(descriptor)  # As the real one, it fails where nothing is open.

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", sync)
        yield


@pytest.fixture(scope="session")
def real_objects() -> Path:
    """Folder of real objects, which tests must never write to."""
    return Path(os.environ[OBJECTS_VARIABLE])


@pytest.fixture(scope="session")
def s3_endpoint() -> Iterator[str]:
    """Address of an S3 server on loopback that lives as long as the tests."""
    from benchmarks.s3_server import loopback_server

    with loopback_server() as endpoint:
        yield endpoint


@pytest.fixture
def s3_url(s3_endpoint: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """A prefix of its own on that server, which the environment names."""
    for name in [name for name in os.environ if name.startswith("AWS_")]:
        monkeypatch.delenv(name)
    for name, value in (("ACCESS_KEY_ID", "test"), ("SECRET_ACCESS_KEY", "test"), ("REGION", "us-east-1")):
        monkeypatch.setenv(f"AWS_{name}", value)
    monkeypatch.setenv("AWS_ENDPOINT_URL", s3_endpoint)
    return f"s3://adaafford/{uuid.uuid4().hex}"


@pytest.fixture(params=["disk", "bucket"])
def where(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """A place for a store, of each kind."""
    if request.param == "disk":
        return str(tmp_path / "store")
    url: str = request.getfixturevalue("s3_url")
    return url
