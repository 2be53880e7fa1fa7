"""Writes assemblies as folders in PartNet-Mobility's layout."""

import json
from collections.abc import Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

from collector.objects.articulation import Mesh
from collector.objects.files import short
from collector.objects.partnet import META_FILE, SEMANTICS_FILE, URDF_FILE
from collector.objects.procedural.assembly import MovablePart, ProceduralObject
from collector.objects.procedural.catalogue import CATEGORIES, build
from collector.objects.procedural.shapes import Pieces, Point
from shared.errors import UsageError
from shared.io.files import TEMPORARY_PREFIX, remove_if_abandoned, remove_tree, temporary_name

MESH_FOLDER = "textured_objs"
_MOTION_WORDS = {"revolute": "hinge", "prismatic": "slider"}


def generate(out: Path, counts: Mapping[str, int], seed: int) -> list[Path]:
    """Write `counts[category]` objects of each category below `out`; what is there already is kept.

    Object number i of a category depends on the seed, the category and i alone. An object appears whole or not at all.

    Args:
        out: folder of objects; made if need be.
        counts: how many of each category of `CATEGORIES`.
        seed: of the whole collection, non-negative.

    Returns:
        The objects' folders, category by category.

    Raises:
        UsageError: an unknown category, a negative count or seed, or a folder that cannot be written or holds another
            object of the same name.
    """
    unknown = sorted(set(counts) - set(CATEGORIES))
    if unknown:
        raise UsageError(f"unknown category {short(unknown[0])}; allowed: {', '.join(CATEGORIES)}")
    if seed < 0 or min(counts.values(), default=0) < 0:
        raise UsageError(f"seed and counts must not be negative; given seed {seed}, counts {dict(counts)}")
    try:
        out.mkdir(parents=True, exist_ok=True)
        for remnant in out.glob(f"{TEMPORARY_PREFIX}*"):
            remove_if_abandoned(remnant)
        return [
            _write_folder(out / f"{category.lower()}-{index:04d}", object_files(build(category, seed, index)))
            for category, count in counts.items()
            for index in range(count)
        ]
    except OSError as error:
        raise UsageError(f"{out}: cannot be written ({error.strerror}); name a folder that can") from None


def write_object(folder: Path, assembly: ProceduralObject) -> Path:
    """Write one object as `folder`, whose name becomes its id.

    Raises:
        UsageError: there is another object of that name.
    """
    return _write_folder(folder, object_files(assembly))


def object_files(assembly: ProceduralObject) -> dict[str, str]:
    """The files of an object, by relative path."""
    bodies = [(assembly.body_name, assembly.body), *((part.name, part.pieces) for part in assembly.parts)]
    # As in PartNet-Mobility, movable links come first and the body last.
    links = [f"link_{len(assembly.parts)}", *(f"link_{index}" for index in range(len(assembly.parts)))]
    files = {
        f"{MESH_FOLDER}/{link}-{number}.obj": _obj(piece)
        for link, (_, pieces) in zip(links, bodies, strict=True)
        for number, piece in enumerate(pieces)
    }
    words = ["static", *(_MOTION_WORDS[part.kind] for part in assembly.parts)]
    files[SEMANTICS_FILE] = "".join(
        f"{link} {word} {name}\n" for link, word, (name, _) in zip(links, words, bodies, strict=True)
    )
    files[META_FILE] = json.dumps({"model_cat": assembly.category, "generator": "adaafford"}) + "\n"
    files[URDF_FILE] = _urdf(assembly, links)
    return files


def _urdf(assembly: ProceduralObject, links: list[str]) -> str:
    lines = ['<?xml version="1.0"?>', f"<robot name={quoteattr(assembly.category)}>", '\t<link name="base"/>']
    lines += _link_lines(links[0], assembly.body_name, assembly.body, (0.0, 0.0, 0.0))
    lines += _joint_lines("joint_body", "fixed", "base", links[0], (0.0, 0.0, 0.0))
    for index, part in enumerate(assembly.parts):
        parent, parent_origin = _parent(assembly, part)
        offset = (
            part.origin[0] - parent_origin[0],
            part.origin[1] - parent_origin[1],
            part.origin[2] - parent_origin[2],
        )
        link = links[index + 1]
        lines += _link_lines(link, part.name, part.pieces, part.origin)
        lines += _joint_lines(f"joint_{index}", part.kind, links[parent], link, offset, part)
    return "\n".join([*lines, "</robot>", ""])


def _parent(assembly: ProceduralObject, part: MovablePart) -> tuple[int, Point]:
    """Index among links, and frame origin, of what the part hangs on."""
    if part.parent is None:
        return 0, (0.0, 0.0, 0.0)
    return part.parent + 1, assembly.parts[part.parent].origin


def _link_lines(link: str, name: str, pieces: Pieces, origin: Point) -> list[str]:
    """A link whose frame stands at `origin`; its meshes are kept in the object's frame, as PartNet-Mobility does."""
    lines = [f'\t<link name="{link}">']
    for tag in ("visual", "collision"):
        for number in range(len(pieces)):
            lines += [
                f'\t\t<{tag} name="{name}-{number}">',
                f'\t\t\t<origin xyz="{_numbers((-origin[0], -origin[1], -origin[2]))}"/>',
                f'\t\t\t<geometry><mesh filename="{MESH_FOLDER}/{link}-{number}.obj"/></geometry>',
                f"\t\t</{tag}>",
            ]
    return [*lines, "\t</link>"]


def _joint_lines(
    name: str, kind: str, parent: str, child: str, xyz: Point, part: MovablePart | None = None
) -> list[str]:
    lines = [
        f'\t<joint name="{name}" type="{kind}">',
        f'\t\t<origin xyz="{_numbers(xyz)}"/>',
        f'\t\t<parent link="{parent}"/>',
        f'\t\t<child link="{child}"/>',
    ]
    if part is not None:
        lines.append(f'\t\t<axis xyz="{_numbers(part.axis)}"/>')
        lines.append(f'\t\t<limit lower="{part.lower!r}" upper="{part.upper!r}"/>')
    return [*lines, "\t</joint>"]


def _obj(mesh: Mesh) -> str:
    vertices = "".join(f"v {_numbers((x, y, z))}\n" for x, y, z in mesh.vertices.tolist())
    return vertices + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in mesh.faces.tolist())


def _numbers(xyz: Point) -> str:
    # Adding zero turns -0.0 into 0.0.
    return " ".join(repr(number + 0.0) for number in xyz)


def _write_folder(folder: Path, files: Mapping[str, str]) -> Path:
    """Write beside and rename; a folder that holds the same is left as it is."""
    if folder.exists():
        if _holds(folder, files):
            return folder
        raise UsageError(f"{folder}: holds another object; name another folder, or the seed that it was made with")
    # Readers pass over hidden folders, so a kill leaves nothing that could be taken for an object.
    partial = folder.parent / temporary_name(folder.name)
    try:
        (partial / MESH_FOLDER).mkdir(parents=True)
        for name, text in files.items():
            (partial / name).write_text(text, encoding="utf-8", newline="\n")
        try:
            partial.rename(folder)
        except OSError:
            # Another process may have written the same object meanwhile.
            if not _holds(folder, files):
                raise
    finally:
        remove_tree(partial)
    return folder


def _holds(folder: Path, files: Mapping[str, str]) -> bool:
    """Whether the folder holds these very files."""
    for name, text in files.items():
        path = folder / name
        if not path.is_file() or path.stat().st_size > 2 * len(text) or path.read_bytes() != text.encode():
            return False
    return True
