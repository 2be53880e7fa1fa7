"""No secret in any message, and no place of somebody's machine in what people publish."""

import json
import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import TypeAdapter, ValidationError

from cluster.cli import main
from cluster.config.campaign_config import RayAddress
from cluster.runs.streams import JsonLines, Lines
from shared.errors import UsageError
from shared.io.text import without_places, without_secrets

SECRET = "correct-horse-battery"  # noqa: S105 - it opens nothing.


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (f"GET http://me:{SECRET}@host:9000/b failed", "GET http://***@host:9000/b failed"),
        (f"'https://me:{SECRET}@host'", "'https://***@host'"),
        (f"http://me:a@{SECRET}@host/", "http://***@host/"),
        (f"ray://{SECRET}@head:10001", "ray://***@head:10001"),
        (f"given 'me:{SECRET}@head:6379'", "given '***@head:6379'"),
        (f"?X-Amz-Signature={SECRET}&x=1", "?X-Amz-Signature=***&x=1"),
        (f"token {SECRET} sent", "token *** sent"),
        ("s3://bucket/a@b is fine: e@mail.org", "s3://bucket/a@b is fine: e@mail.org"),
    ],
)
def test_secrets_are_hidden(text: str, shown: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_SESSION_TOKEN", SECRET)
    assert without_secrets(text) == shown
    assert without_secrets(shown) == shown


def test_every_way_of_a_message_hides_them(capsys: pytest.CaptureFixture[str]) -> None:
    told = f"http://me:{SECRET}@host/ is out of reach"

    def fail() -> int:
        raise UsageError(told)

    def interrupt() -> int:
        raise KeyboardInterrupt

    assert main.guarded(fail, ["run"]) == 2
    assert main.guarded(interrupt, ["collect", "--ray-address", f"ray://me:{SECRET}@host"]) == 130
    record = logging.LogRecord("cluster", logging.ERROR, "", 0, "%s", (told,), None)
    print(Lines().format(record), JsonLines().format(record))
    json.loads(JsonLines().format(record))
    try:
        raise RuntimeError(told)
    except RuntimeError as error:
        main._show_traceback(type(error), error, error.__traceback__)
    out, err = capsys.readouterr()
    assert SECRET not in out + err
    assert (out + err).count("***@host") == 5


def test_an_address_of_a_cluster_holds_no_secret() -> None:
    with pytest.raises(ValidationError, match="may hold no user and password"):
        TypeAdapter(RayAddress).validate_python(f"ray://me:{SECRET}@host:1")
    assert TypeAdapter(RayAddress).validate_python("ray://host:1") == "ray://host:1"


@pytest.mark.slow
def test_a_bucket_out_of_reach_is_told_without_the_secrets_of_its_address() -> None:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("AWS_")}
    environment |= {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": SECRET, "AWS_REGION": "us-east-1"}
    environment["AWS_ENDPOINT_URL"] = f"http://me:{SECRET}@127.0.0.1:9/"
    environment["PYTHONPATH"] = str(Path(__file__).parents[2])
    command = [sys.executable, "-m", "cluster", "store", "info", "s3://some-bucket/store"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 2
    assert SECRET not in done.stdout + done.stderr
    assert done.stderr.startswith("adaafford: s3://some-bucket/store: ")


def test_places_are_told_from_the_run_and_from_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/somebody")
    run = tmp_path / "runs" / "a"
    run.mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    for text, shown in (
        (f"{run}/training/prior: done", "training/prior: done"),
        (f"in {run}, in {run}-2", f"in ., in {run}-2"),
        ("runs/a/store is open", "store is open"),
        ("no file '/home/somebody/x.py'", "no file '~/x.py'"),
        ("/home/somebody-else/x", "/home/somebody-else/x"),
        ("step 3/9, 4/home/somebody", "step 3/9, 4/home/somebody"),
    ):
        assert without_places(text, Path("runs/a")) == shown
