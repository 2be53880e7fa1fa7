"""Reader of one object in PartNet-Mobility's layout; docs/objects.md describes it for users.

    <id>/mobility.urdf, meta.json, semantics.txt, textured_objs/*.obj

The folder's name is the object's id. Everything in it is hostile until checked. A mesh that is absent or unusable is
left out, as the simulator's own reader does, and noted; a part that keeps no shape at all makes the object unusable.
"""

import hashlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from pydantic_core import from_json

from collector.objects.articulation import ends_at_zero
from collector.objects.files import ObjectFiles, add_framed
from collector.objects.readers import MAX_WORD, Description
from collector.objects.urdf_bodies import UrdfBodies, UrdfMeshes, joint_notes, listed
from shared.errors import ObjectError
from shared.io.text import short
from shared.urdf import MAX_URDF_BYTES, parse_urdf

MAX_TEXT_BYTES = 1 << 20
URDF_FILES = ("mobility.urdf", "mobility_vhacd.urdf", "mobility_cvx.urdf")
"""The first that is there is read; the others are what Where2Act and ManiSkill derive from it."""
URDF_FILE = URDF_FILES[0]
META_FILE = "meta.json"
SEMANTICS_FILE = "semantics.txt"


def urdf_of(folder: Path) -> str | None:
    """The name of the URDF in a folder; None where it holds no object."""
    return next((name for name in URDF_FILES if (folder / name).is_symlink() or (folder / name).exists()), None)


class PartNetReader:
    """Reads, checks and merges one object."""

    def matches(self, folder: Path) -> bool:
        """Whether there is a URDF of one of the known names."""
        return urdf_of(folder) is not None

    def read(self, files: ObjectFiles) -> Description:
        """The object; raises as every reader does."""
        folder = files.folder
        urdf_file = urdf_of(folder) or URDF_FILE
        urdf_bytes = files.read(urdf_file, MAX_URDF_BYTES)
        category = category_of(files)
        semantics = files.read(SEMANTICS_FILE, MAX_TEXT_BYTES) if files.exists(SEMANTICS_FILE) else b""
        urdf = parse_urdf(urdf_bytes, str(folder / urdf_file))
        if all(joint.kind == "fixed" for joint in urdf.joints):
            raise ObjectError(f"{folder}: has no movable part: every joint is fixed")
        documents = {urdf_file: urdf_bytes, SEMANTICS_FILE: semantics, "category": category.encode()}
        # Of the category alone, since the rest of meta.json does not matter; and of the names that the URDF has.
        found, digest = UrdfMeshes(_BelowFolder(files), str(folder)), hashlib.sha256()
        for name in sorted({*documents, *urdf.mesh_files()}):
            data = documents[name] if name in documents else found.load(name)
            if data is not None:
                add_framed(digest, name.encode("utf-8", "surrogatepass"), data)
        names = part_names(semantics, str(folder / SEMANTICS_FILE))
        merging = UrdfBodies(urdf, found, names, str(folder))
        bodies = merging.merged()
        notes = [] if urdf_file == URDF_FILE else [f"read from {urdf_file}"]
        if unknown := [short(link) for link in names if link not in urdf.links]:
            notes.append(f"{SEMANTICS_FILE} names links that are not there ({listed(unknown)})")
        notes += [*found.notes(), *merging.notes(), *joint_notes(urdf, bodies)]
        joints = [body.joint for body in bodies if body.joint is not None]
        if backward := [short(joint.name) for joint in joints if ends_at_zero(joint.lower, joint.upper)]:
            notes.append(
                f"{len(backward)} of {len(joints)} joints have limits that end at 0, and the lower limit is taken for "
                f"closed; if 0 is closed, `adaafford objects import` turns them round ({listed(backward)})"
            )
        return Description(category, bodies, tuple(notes), digest.hexdigest())


READER = PartNetReader()


def category_of(files: ObjectFiles) -> str:
    """`model_cat` of meta.json.

    Raises:
        ObjectError: there is none.
    """
    if not files.exists(META_FILE):
        raise ObjectError(
            f"{files.folder}: '{META_FILE}' is missing; write one that names the category, such as "
            '{"model_cat": "StorageFurniture"} (docs/objects.md)'
        )
    data = files.read(META_FILE, MAX_TEXT_BYTES)
    try:
        meta = from_json(_text(data))
    except ValueError as error:
        # The parser's words name the cause and the place.
        raise ObjectError(f"{files.folder / META_FILE}: malformed JSON ({error})") from None
    category = meta.get("model_cat") if isinstance(meta, dict) else None
    if not isinstance(category, str) or not 0 < len(category) <= MAX_WORD or not category.isprintable():
        raise ObjectError(f"{files.folder / META_FILE}: needs a 'model_cat', the category's name (docs/objects.md)")
    return category


def _text(data: bytes) -> str:
    """UTF-8 text, with or without a byte order mark; a ValueError says where it is none."""
    try:
        text, wrong = data.decode("utf-8-sig"), data.find(b"\0")
    except UnicodeDecodeError as error:
        text, wrong = "", error.start
    if wrong >= 0:
        # UTF-16 without a byte order mark is valid UTF-8 with zero bytes in it.
        line, column = data.count(b"\n", 0, wrong) + 1, wrong - data.rfind(b"\n", 0, wrong)
        raise ValueError(f"not UTF-8 text at line {line} column {column}; save it in UTF-8")
    return text


def part_names(semantics: bytes, where: str) -> dict[str, str]:
    """Semantic name by link, from lines of link, kind of joint, name.

    Raises:
        ObjectError: it is not made of such lines.
    """
    try:
        lines = [line.split() for line in semantics.decode("utf-8-sig").splitlines()]
    except UnicodeDecodeError:
        raise ObjectError(f"{where}: not UTF-8 text") from None
    names = {}
    for number, words in enumerate(lines, start=1):
        if not words:
            continue
        if len(words) != 3 or not all(len(word) <= MAX_WORD and word.isprintable() for word in words):
            raise ObjectError(f"{where}: line {number} is not '<link> <kind of joint> <name>'")
        names[words[0]] = words[2]
    return names


class _BelowFolder:
    """The mesh files of an object's folder."""

    def __init__(self, files: ObjectFiles) -> None:
        self._files = files
        self._elsewhere: list[str] = []

    def find(self, name: str, most_bytes: int) -> tuple[str, bytes] | None:
        """See `MeshFiles`."""
        file = self._path(name)
        return (file, self._files.read(file, most_bytes)) if self._files.exists(file) else None

    def notes(self) -> Iterator[str]:
        """What was found under another path."""
        if self._elsewhere:
            yield f"{len(self._elsewhere)} meshes found by the ends of their paths ({listed(self._elsewhere)})"

    def _path(self, name: str) -> str:
        """The path below the folder of the file that the URDF calls `name`.

        Of a URI, an absolute path or one that leads out of the folder it is the longest end that is there: whoever
        wrote it had the folder elsewhere.
        """
        folder, (_, separator, rest) = self._files.folder, name.partition("://")
        parts = PurePosixPath((unquote(rest) if separator else name).replace("\\", "/")).parts
        outside = [k for k, part in enumerate(parts) if part in ("..", "/") or part.endswith(":")]
        if not separator and not outside and "\\" not in name:
            return name
        last = max(outside, default=-1)
        ends = ["/".join(parts[k:]) for k in range(last + 1, len(parts))]
        found = next((end for end in ends if self._files.is_file(end)), None)
        if found is None:
            raise ObjectError(
                f"{folder}: the mesh {short(name)} is not a plain path below the object's folder, and no file "
                "in it has the end of that path; copy the file there and name it relative to the URDF (docs/objects.md)"
            )
        self._elsewhere.append(short(name))
        return found
