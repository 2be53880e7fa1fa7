"""`adaafford view`: a store, a run or a scan in the browser."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from adaafford.recordings import WHOLE, Selection, is_recording
from cluster.config.flags import OutFile, parse_flags
from shared.errors import UsageError
from shared.io.text import plain

if TYPE_CHECKING:
    import viser

    from shared.policies.policy import Policy
    from shared.store import Store

MOST_POLICIES = 2


@dataclass(frozen=True, slots=True)
class ViewCommand:
    """Look at a store, a run or a scan in the browser; Ctrl-C ends the viewer.

    Of a store: rollouts, filtered; each interaction as it is simulated; what policies believe after each interaction.
    Of a scan: clicks mark the movable points for `adaafford adapt`. docs/viewer.md shows pictures.
    """

    target: Annotated[str, tyro.conf.Positional]
    """A store (folder or s3:// URL), a run, or a scan (.ply, .npz, .pcd, or a recording of ROS 2: .mcap or .db3)."""
    policy: tuple[str, ...] = ()
    """One or two policies to be shown first, side by side: names of bundled policies, folders, or finished runs.
    Default: the newest policy of the store, if it has one; all of its policies can be chosen in the browser."""
    objects: Path | None = None
    """Folder of the store's objects, for the simulation. Default: the run's, or the procedural ones of the store."""
    port: int = 8080
    """Of 127.0.0.1; 0: a free one. From another machine: ssh -L 8080:127.0.0.1:8080 HOST."""
    out: OutFile | None = None
    """The file that the marks of a scan are saved to (.npz). Default: SCAN-marked.npz beside the scan."""
    overwrite: tyro.conf.FlagCreatePairsOff[bool] = False
    """Replace that file if it is there."""
    up: tuple[float, float, float] | None = None
    """The direction against gravity in a scan's frame; default: that of the scan, otherwise 0 0 1."""
    camera: tuple[float, float, float] | None = None
    """The camera position in a scan's frame; default: that of the scan, otherwise 0 0 0."""
    recorded: Annotated[Selection, tyro.conf.arg(name="")] = WHOLE


def main(args: list[str]) -> int:
    """Show something until Ctrl-C."""
    command, ended = parse_flags(ViewCommand, args, "view"), threading.Event()
    with viewing(command) as server:
        port = server.get_port()
        # An exception in the middle of printing would have the line printed twice.
        before = signal.signal(signal.SIGINT, lambda *_: ended.set())
        print(f"http://127.0.0.1:{port} shows it, on this machine only; Ctrl-C ends the viewer")
        print(f"from another machine: ssh -L {port}:127.0.0.1:{port} HOST, then the same address", flush=True)
        ended.wait()
        signal.signal(signal.SIGINT, before)
    print("the viewer has ended")
    return 0


@contextmanager
def viewing(command: ViewCommand) -> "Iterator[viser.ViserServer]":
    """The server with its page.

    Raises:
        UsageError: a flag or the port is not allowed, or there is no such thing to show.
        StoreError: the store, the scan or a policy is damaged.
    """
    if not 0 <= command.port <= 65535:
        raise UsageError(f"--port {command.port}: allowed are 0 to 65535")
    if len(command.policy) > MOST_POLICIES:
        raise UsageError(f"--policy: at most {MOST_POLICIES} are shown side by side; given {len(command.policy)}")
    show = _scan_page(command) if _is_scan(command.target) else _store_page(command)
    from cluster.viewing.server import serving

    with serving(command.port) as server:
        show(server)
        yield server


def _is_scan(target: str) -> bool:
    from adaafford.scans import READERS

    path = Path(target)
    return "://" not in target and (is_recording(path) or (not path.is_dir() and path.suffix.lower() in READERS))


def _scan_page(command: ViewCommand) -> "Callable[[viser.ViserServer], object]":
    from adaafford.pretrained import load_policy
    from adaafford.scans import ScanFrame, doubtful_up, read_scan

    path = Path(command.target)
    out = command.out or path.with_name(f"{path.stem}-marked.npz")
    if command.objects is not None or len(command.policy) > 1:
        raise UsageError(f"{path}: is a scan, which takes no --objects and one --policy; leave the others out")
    if out.suffix.lower() != ".npz":
        raise UsageError(f"--out {out}: marks are saved as NPZ; give a name that ends with .npz")
    if out.exists() and not command.overwrite:
        raise UsageError(f"{out}: is there already; name another file by --out, or replace it with --overwrite")
    scan = read_scan(path, command.recorded)
    frame = ScanFrame.around(scan, command.up, command.camera)
    if command.up is None and (doubt := doubtful_up(scan, frame)) is not None:
        print(plain(f"{path}: {doubt}; say so by --up"))
    policy = load_policy(command.policy[0]) if command.policy else None
    from cluster.viewing.scan_page import ScanPage

    return partial(ScanPage, scan=scan, frame=frame, out=out, overwrite=command.overwrite, policy=policy)


def _store_page(command: ViewCommand) -> "Callable[[viser.ViserServer], object]":
    from adaafford.pretrained import load_policy
    from cluster.runs.run_folder import RunFolder
    from shared.store import Store
    from shared.store.backends.base import folder_beside, is_url

    for_scans = (command.out, command.camera, command.up)
    if command.overwrite or command.recorded != WHOLE or any(given is not None for given in for_scans):
        flags = "--out, --overwrite, --up, --camera, --topic, --at and --frame"
        raise UsageError(f"{command.target}: is no scan; {flags} are for scans")
    run = None if is_url(command.target) else RunFolder(Path(command.target))
    objects: Path | None
    if run is not None and run.config.is_file():
        places = {"collection": run.store, "evaluation": run.evaluation}
        stores = {name: Store.open(place) for name, place in places.items() if place.is_dir()}
        if not stores:
            raise UsageError(f"{command.target}: the run has no store yet; wait until it collects")
        objects, known = command.objects, next(iter(stores.values()))
        if objects is None:
            with suppress(UsageError):  # Only the simulation needs them, and says so.
                objects = run.objects_folder()
    else:
        known = Store.open(command.target)
        stores, beside = {"store": known}, folder_beside(command.target, "objects")
        objects = command.objects or (beside if beside.is_dir() else None)
    if command.objects is not None and not command.objects.is_dir():
        raise UsageError(f"--objects {command.objects}: there is no such folder; name that of the store's objects")
    published = known.policy_versions()
    loaded = {name: load_policy(name) for name in dict.fromkeys(command.policy)}
    for name, policy in loaded.items():
        policy.require_task(known.setting.task, f"--policy {name}")
    given = {plain(name): partial(lambda policy: policy, policy) for name, policy in loaded.items()}
    policies = given | {f"version {each}": partial(_published, known, each) for each in published}
    newest = [f"version {each}" for each in published[-1:]]
    from cluster.viewing.store_page import StorePage

    return partial(StorePage, stores=stores, policies=policies, compared=[*given] or newest, objects=objects)


def _published(store: "Store", version: int) -> "Policy":
    from shared.policies.policy import Policy

    return Policy.from_files(store.read_policy(version))
