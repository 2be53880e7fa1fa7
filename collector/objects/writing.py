"""Writes objects as folders in PartNet-Mobility's layout, which `collector.objects.partnet` reads."""

import json
from collections.abc import Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

from collector.objects.articulation import Mesh
from collector.objects.model import MovablePart, ObjectModel, Pieces, Point
from collector.objects.partnet import META_FILE, SEMANTICS_FILE, URDF_FILE
from shared.errors import UsageError
from shared.io.files import remove_tree, sync_folder, temporary_name, write_new_folder

MESH_FOLDER = "textured_objs"
GENERATOR = "adaafford"
MOTION_WORDS = {"revolute": "hinge", "prismatic": "slider"}
"""What semantics.txt calls the kinds of joints."""


def write_object(folder: Path, model: ObjectModel, meta: Mapping[str, object] | None = None) -> Path:
    """Write one object as `folder`, whose name becomes its id; it appears whole or not at all.

    Args:
        folder: made; one that holds the same is left as it is.
        model: the object.
        meta: what else meta.json says; readers pass over it.

    Raises:
        UsageError: there is another object of that name.
        OSError: the folder cannot be written.
    """
    return write_folder(folder, object_files(model, meta))


def object_files(model: ObjectModel, meta: Mapping[str, object] | None = None) -> dict[str, str]:
    """The files of an object, by relative path."""
    links = link_names(model)
    names = [model.body_name, *(part.name for part in model.parts)]
    shapes = [(model.body, model.body_collisions), *((part.pieces, part.collisions) for part in model.parts)]
    files: dict[str, str] = {}
    for link, (pieces, collisions) in zip(links, shapes, strict=True):
        files |= {f"{MESH_FOLDER}/{link}-{number}.obj": obj_text(piece) for number, piece in enumerate(pieces)}
        own = enumerate(collisions or ())
        files |= {f"{MESH_FOLDER}/{link}-collision-{number}.obj": obj_text(piece) for number, piece in own}
    words = ["static", *(MOTION_WORDS[part.kind] for part in model.parts)]
    files[SEMANTICS_FILE] = "".join(
        f"{link} {word} {name}\n" for link, word, name in zip(links, words, names, strict=True)
    )
    files[META_FILE] = json.dumps({"model_cat": model.category, "generator": GENERATOR, **(meta or {})}) + "\n"
    files[URDF_FILE] = _urdf(model, links)
    return files


def link_names(model: ObjectModel) -> list[str]:
    """The links of the body and of the parts; as in PartNet-Mobility, those that move come first and the body last."""
    return [f"link_{len(model.parts)}", *(f"link_{index}" for index in range(len(model.parts)))]


def obj_text(mesh: Mesh) -> str:
    """A mesh as a Wavefront OBJ file, from which it can be read again to the last bit."""
    vertices = "".join(f"v {numbers_text((x, y, z))}\n" for x, y, z in mesh.vertices.tolist())
    return vertices + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in mesh.faces.tolist())


def numbers_text(numbers: tuple[float, ...]) -> str:
    """Numbers with blanks between them, each as short as it can be read again to the last bit."""
    # Adding zero turns -0.0 into 0.0.
    return " ".join(repr(number + 0.0) for number in numbers)


def parent_origins(model: ObjectModel) -> list[Point]:
    """Where, in the object's frame, the frame stands of what each part hangs on."""
    return [(0.0, 0.0, 0.0) if part.parent is None else model.parts[part.parent].origin for part in model.parts]


def offset(point: Point, origin: Point) -> Point:
    """`point` as seen from a frame at `origin`."""
    return point[0] - origin[0], point[1] - origin[1], point[2] - origin[2]


def _urdf(model: ObjectModel, links: list[str]) -> str:
    lines = ['<?xml version="1.0"?>', f"<robot name={quoteattr(model.category)}>", '\t<link name="base"/>']
    lines += _link_lines(links[0], model.body_name, model.body, model.body_collisions, (0.0, 0.0, 0.0))
    lines += _joint_lines("joint_body", "fixed", "base", links[0], (0.0, 0.0, 0.0))
    for index, (part, parent_origin) in enumerate(zip(model.parts, parent_origins(model), strict=True)):
        link, parent = links[index + 1], 0 if part.parent is None else part.parent + 1
        lines += _link_lines(link, part.name, part.pieces, part.collisions, part.origin)
        place = offset(part.origin, parent_origin)
        lines += _joint_lines(f"joint_{index}", part.kind, links[parent], link, place, part)
    return "\n".join([*lines, "</robot>", ""])


def _link_lines(link: str, name: str, pieces: Pieces, collisions: Pieces | None, origin: Point) -> list[str]:
    """A link whose frame stands at `origin`; its meshes are kept in the object's frame, as PartNet-Mobility does."""
    lines = [f'\t<link name="{link}">']
    colliding = ("", pieces) if collisions is None else ("-collision", collisions)
    for tag, (suffix, shown) in (("visual", ("", pieces)), ("collision", colliding)):
        for number in range(len(shown)):
            lines += [
                f"\t\t<{tag} name={quoteattr(f'{name}-{number}')}>",
                f'\t\t\t<origin xyz="{numbers_text((-origin[0], -origin[1], -origin[2]))}"/>',
                f'\t\t\t<geometry><mesh filename="{MESH_FOLDER}/{link}{suffix}-{number}.obj"/></geometry>',
                f"\t\t</{tag}>",
            ]
    return [*lines, "\t</link>"]


def _joint_lines(
    name: str, kind: str, parent: str, child: str, xyz: Point, part: MovablePart | None = None
) -> list[str]:
    lines = [
        f'\t<joint name="{name}" type="{kind}">',
        f'\t\t<origin xyz="{numbers_text(xyz)}"/>',
        f'\t\t<parent link="{parent}"/>',
        f'\t\t<child link="{child}"/>',
    ]
    if part is not None:
        lines.append(f'\t\t<axis xyz="{numbers_text(part.axis)}"/>')
        lines.append(f'\t\t<limit lower="{part.lower!r}" upper="{part.upper!r}"/>')
    return [*lines, "\t</joint>"]


def write_folder(folder: Path, files: Mapping[str, str]) -> Path:
    """Write files, by relative path, beside `folder` and rename; a folder that holds the same is left as it is.

    Raises:
        UsageError: the folder holds other files.
        OSError: it cannot be written.
    """
    if folder.exists():
        if holds(folder, files):
            return folder
        raise UsageError(f"{folder}: holds another object, or one of another seed or mass; name another folder")
    # Readers pass over hidden folders, so a kill leaves nothing that could be taken for an object.
    partial = folder.parent / temporary_name(folder.name)
    try:
        write_new_folder(partial, {name: text.encode() for name, text in files.items()})
        try:
            partial.rename(folder)
        except OSError:
            # Another process may have written the same object meanwhile.
            if not holds(folder, files):
                raise
        sync_folder(folder.parent)
    finally:
        remove_tree(partial)
    return folder


def holds(folder: Path, files: Mapping[str, str]) -> bool:
    """Whether the folder holds these very files."""
    for name, text in files.items():
        path = folder / name
        if not path.is_file() or path.stat().st_size > 2 * len(text) or path.read_bytes() != text.encode():
            return False
    return True
