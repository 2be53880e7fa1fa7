"""The programs that exports are for, in environments of their own, read what the store holds."""

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from shared.store import export
from tests.store.test_export_formats import LACKING, SPLITS, expected, make, same
from tests.support import export_readers
from tests.support.environments import environment, install
from tests.support.hub_server import hub_server

ROOT = Path(__file__).parents[2]
ROWS = 10
QUICK = ("datasets", "duckdb", "polars", "webdataset", "minari[arrow]", "pillow")
"""Minari's extra lacks Pillow, which it imports."""
LEROBOT = (
    ("lerobot==0.4.4", "torchvision==0.28.0"),
    (
        *("datasets>=4,<5", "huggingface-hub<1", "einops", "jsonlines", "draccus==0.10.0", "deepdiff", "gymnasium<2"),
        *("termcolor", "accelerate", "imageio", "av<16", "pillow"),
    ),
)
"""What is installed without its dependencies, which are gigabytes for GPUs, and those that reading needs."""


def check(folder: Path, python: Path, readers: dict[str, str]) -> None:
    """Export a store, let readers read it, and compare; `readers` says which format each reads."""
    store = make(folder / "store")
    for name in set(readers.values()):
        export(store, folder / name, SPLITS, format=name)
    script = Path(export_readers.__file__)
    args = [python, script, folder, str(ROWS), *readers]
    done = subprocess.run(args, capture_output=True, text=True, env={"HF_HUB_OFFLINE": "1", "HOME": str(folder)})
    assert done.returncode == 0, done.stderr[-3000:]
    for (split, rows), (reader, name) in (
        (rows, reader) for rows in expected(store).items() for reader in readers.items()
    ):
        found = np.load(folder / f"{reader}-{split}.npz")
        assert found["__count__"] == len(rows)
        for column in [column for column in rows[0] if column not in LACKING.get(name, ())]:
            wanted = [row[column] for row in rows[:ROWS]]
            if column == "joint_positions" or (column == "displacement" and name == "webdataset"):
                continue  # Of several lengths; JSON has null for NaN. The other tests compare these.
            assert same(found[column], np.array(wanted)), (reader, split, column)


@pytest.mark.slow
def test_datasets_duckdb_polars_webdataset_and_minari_read_exports(tmp_path: Path) -> None:
    python = environment(tmp_path / "venv")
    install(python, *QUICK)
    formats = {"datasets": "hf", "duckdb": "hf", "polars": "hf", "webdataset": "webdataset", "minari": "minari"}
    check(tmp_path, python, formats)


@pytest.mark.slow
def test_lerobot_reads_its_export(tmp_path: Path) -> None:
    python = environment(tmp_path / "venv")
    for args in (["--no-deps", *LEROBOT[0]], LEROBOT[1]):
        install(python, *args)
    check(tmp_path, python, {"lerobot": "lerobot"})


@pytest.mark.slow
def test_an_export_is_put_on_a_hub_with_the_token_of_the_environment_alone(tmp_path: Path) -> None:
    python = environment(tmp_path / "venv")
    install(python, "huggingface_hub")
    store, out = make(tmp_path / "store"), tmp_path / "out"
    args = [
        python,
        "-m",
        "cluster",
        "store",
        "export",
        store.where,
        "--out",
        out,
        "--format",
        "hf",
        "--push",
        "me/data",
    ]

    def push(address: str) -> "subprocess.CompletedProcess[str]":
        env = {"HF_ENDPOINT": address, "HF_TOKEN": "hf_of_somebody", "HOME": str(tmp_path), "PATH": os.environ["PATH"]}
        return subprocess.run(args, capture_output=True, text=True, env=env, cwd=ROOT)

    for status, said in ((401, "401 (the token in HF_TOKEN is not accepted)"), (500, "500 (try again later)")):
        with hub_server(status) as server:
            done = push(server.address)
        lines = [line for line in done.stderr.splitlines() if not line.startswith("exporting into")]
        assert (done.returncode, len(lines)) == (2, 1), done.stderr
        assert said in lines[0]
        assert not out.exists()
    with hub_server() as server:
        done = push(server.address)
        assert done.returncode == 0, done.stderr
        assert server.tokens == {"Bearer hf_of_somebody"}
        assert server.files == {str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*.*")}
