"""Hostile versions of good objects: `mutate(folder, rng)` damages one object's folder in one random way.

A mutation is a function of the folder and a generator alone, so that a number names a mutant for good.
"""

import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar
from xml.etree.ElementTree import Element, SubElement, fromstring, tostring

import numpy as np

T = TypeVar("T")
Rng = np.random.Generator
Mutation = Callable[[Path, Rng], None]

NUMBER = re.compile(rb"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.])")
# fmt: off
NUMBERS = (
    "nan", "inf", "-inf", "1e308", "-1e308", "1e400", "3.5e38", "1e39", "1e20", "-1e6", "1e6", "999999.9", "1e5",
    "-1e4", "1000", "50", "19", "-7", "0", "-0", "1", "1e-3", "1e-9", "1e-38", "1e-300", "1e-320", "4294967296",
    "-2147483649", "99999999999999999999", "0x10", "1_000", "\u0663", "--1", ".", "e", "five", "1,5", "1;2", "%s",
)
# fmt: on
PATHS = (
    "/etc/passwd",
    "../../../etc/passwd.obj",
    "/dev/zero.obj",
    "textured_objs/../../x.obj",
    "..\\x.obj",
    "~/x.obj",
    "file:///etc/x.obj",
    "a" * 5000 + ".obj",
    "a/" * 90 + ".obj",
    "textured_objs",
    ".",
    "",
    "\u202e.obj",
    "package://x.obj",
)
BOMB = (
    b'<?xml version="1.0"?><!DOCTYPE r [<!ENTITY a "aaaaaaaaaa">'
    + b"".join(b'<!ENTITY %c "%s">' % (b, (b"&%c;" % (b - 1)) * 10) for b in range(ord("b"), ord("k")))
    + b"]><robot>&j;</robot>"
)
EXTERNAL = b'<!DOCTYPE r [<!ENTITY e SYSTEM "file:///etc/passwd">]><robot name="&e;"/>'
CATEGORIES = (
    b"null",
    b"[]",
    b"NaN",
    b"1e999",
    b"{}",
    b'""',
    b'"\\ud800"',
    b'"a\\nb"',
    b'"\\u202e"',
    b'"' + b"x" * 5000 + b'"',
    b"9" * 6000,
    b"[" * 60_000,
    b'{"model_cat":' * 20_000,
)


def mutate(folder: Path, rng: Rng) -> str:
    """Damage one object's folder; returns the name of what was done."""
    mutations = (_URDF, _MESH, _JSON, _FILE)[int(rng.choice(4, p=[0.45, 0.35, 0.1, 0.1]))]
    mutation = pick(rng, mutations)
    mutation(folder, rng)
    return mutation.__name__.strip("_")


def pick(rng: Rng, choices: Sequence[T]) -> T:
    """One of some choices."""
    return choices[int(rng.integers(len(choices)))]


def damaged(data: bytes, a: int, b: int, kind: int, rng: Rng) -> bytes:
    """Data cut off (kind 0), with bytes a to b missing, repeated, random or zero (1 to 4), or with a bit flipped."""
    match kind:
        case 0:
            return data[:a]
        case 1:
            return data[:a] + data[b:]
        case 2:
            return data[:b] + data[a:]
        case 3:
            return data[:a] + rng.bytes(b - a) + data[b:]
        case 4:
            return data[:a] + b"\0" * (b - a) + data[b:]
        case _ if a < len(data):
            return data[:a] + bytes([data[a] ^ 1 << int(rng.integers(8))]) + data[a + 1 :]
    return data


def _urdf(folder: Path) -> Path:
    return folder / "mobility.urdf"


def _json(folder: Path) -> Path:
    return folder / "meta.json"


def _mesh(folder: Path, rng: Rng) -> Path:
    return pick(rng, sorted(folder.rglob("*.obj")))


# Any file, as bytes.


def _noise(path: Path, rng: Rng) -> None:
    """One to four flips, cuts, repetitions or foreign bytes."""
    data = path.read_bytes()
    for _ in range(int(rng.integers(1, 5))):
        a, b = sorted(int(rng.integers(len(data) + 1)) for _ in range(2))
        b = min(b, a + 200)
        match int(rng.integers(7)):
            case 5:
                data = data[:a] + pick(rng, NUMBERS).encode() + data[a:]
            case kind:
                data = damaged(data, a, b, kind, rng)
    path.write_bytes(data)


def _numbers(path: Path, rng: Rng) -> None:
    """Other numbers in place of one, of a few, or of many."""
    odds, data = pick(rng, (0.0, 0.01, 0.2)), path.read_bytes()
    count = len(NUMBER.findall(data))
    chosen = rng.random(count) < odds
    if count:
        chosen[int(rng.integers(count))] = True
    number, which = pick(rng, NUMBERS).encode(), iter(chosen)
    path.write_bytes(NUMBER.sub(lambda match: number if next(which) else match[0], data))


# The URDF, as a tree.


def _edited(edit: Callable[[Element, list[Element], Rng], None]) -> Mutation:
    """A mutation of the URDF from an edit of its root, given all its elements below."""

    def mutation(folder: Path, rng: Rng) -> None:
        robot = fromstring(_urdf(folder).read_bytes())  # noqa: S314 - still the good object's own.
        edit(robot, list(robot.iter())[1:], rng)
        _urdf(folder).write_bytes(tostring(robot))

    mutation.__name__ = "urdf" + edit.__name__
    return mutation


def _parent(robot: Element, child: Element) -> Element:
    return next(element for element in robot.iter() if child in list(element))


def _remove(robot: Element, below: list[Element], rng: Rng) -> None:
    chosen = pick(rng, below)
    _parent(robot, chosen).remove(chosen)


def _duplicate(robot: Element, below: list[Element], rng: Rng) -> None:
    chosen = pick(rng, below)
    parent = _parent(robot, chosen)
    for _ in range(pick(rng, (1, 2, 40))):
        parent.append(chosen)


def _move(robot: Element, below: list[Element], rng: Rng) -> None:
    chosen = pick(rng, below)
    _parent(robot, chosen).remove(chosen)
    pick(rng, [robot, *robot.iter()]).append(chosen)


def _swap_attributes(_: Element, below: list[Element], rng: Rng) -> None:
    having = [element for element in below if element.attrib]
    a, b = pick(rng, having), pick(rng, having)
    alike = [element for element in having if element.tag == a.tag]
    b = pick(rng, alike) if rng.random() < 0.7 else b
    a.attrib, b.attrib = dict(b.attrib), dict(a.attrib)


def _drop_attribute(_: Element, below: list[Element], rng: Rng) -> None:
    chosen = pick(rng, [element for element in below if element.attrib])
    del chosen.attrib[pick(rng, sorted(chosen.attrib))]


def _strange_attribute(_: Element, below: list[Element], rng: Rng) -> None:
    chosen = pick(rng, [element for element in below if element.attrib])
    value = pick(rng, (*PATHS, *NUMBERS, "1 " * 3, "0 0 0", "1e6 1e6 1e6", "-1 1 1", "floating", "x\ny", " "))
    chosen.attrib[pick(rng, sorted(chosen.attrib))] = value


def _strange_path(_: Element, below: list[Element], rng: Rng) -> None:
    pick(rng, [element for element in below if element.tag == "mesh"]).attrib["filename"] = pick(rng, PATHS)


def _scale_meshes(_: Element, below: list[Element], rng: Rng) -> None:
    scale = " ".join(pick(rng, ("1", "-1", "0", "1e-9", "1e-4", "30", "1e6", "nan")) for _ in range(3))
    for mesh in [element for element in below if element.tag == "mesh"]:
        mesh.attrib["scale"] = scale


def _limits(_: Element, below: list[Element], rng: Rng) -> None:
    pairs = ("-inf inf", "inf inf", "-inf -inf", "0 0", "-1e6 1e6", "1e5 1e5", "-30 30", "0 1e-30", "9 10", "1e308 0")
    for limit in [element for element in below if element.tag == "limit"]:
        limit.attrib["lower"], limit.attrib["upper"] = pick(rng, pairs).split()


def _kinds_of_joints(_: Element, below: list[Element], rng: Rng) -> None:
    kinds = ("fixed", "revolute", "continuous", "prismatic", "floating", "planar", "Revolute")
    one = pick(rng, kinds)
    for joint in [element for element in below if element.tag == "joint"]:
        joint.attrib["type"] = one if rng.random() < 0.7 else pick(rng, kinds)


def _reconnect(_: Element, below: list[Element], rng: Rng) -> None:
    """Cycles, several roots, two parents, or just another tree."""
    links = [element.attrib["name"] for element in below if element.tag == "link"]
    ends = [element for element in below if element.tag in ("parent", "child")]
    for _ in range(int(rng.integers(1, 4))):
        pick(rng, ends).attrib["link"] = pick(rng, links)


def _many(robot: Element, below: list[Element], rng: Rng) -> None:
    """A chain or a star of many more links, or many more shapes."""
    count = pick(rng, (30, 120, 254, 300, 700))
    last, kind = pick(rng, [element for element in below if element.tag == "link"]), int(rng.integers(3))
    shapes = [element for element in below if element.tag in ("visual", "collision")]
    for k in range(count):
        if kind == 2:
            last.append(pick(rng, shapes))
            continue
        link = SubElement(robot, "link", name=f"more-{k}")
        link.append(pick(rng, shapes))
        joint = SubElement(robot, "joint", name=f"more-{k}", type=pick(rng, ("continuous", "prismatic")))
        SubElement(joint, "parent", link=last.attrib["name"])
        SubElement(joint, "child", link=f"more-{k}")
        SubElement(joint, "limit", lower="0", upper="0.1")
        SubElement(joint, "axis", xyz=pick(rng, ("1 0 0", "0 1 0", "1 1e-8 1", "0 0 -1e-8")))
        last = link if kind else last


def _deep_urdf(folder: Path, rng: Rng) -> None:
    depth = pick(rng, (500, 20_000, 200_000))
    data = _urdf(folder).read_bytes().replace(b"</robot>", b"")
    _urdf(folder).write_bytes(data + b"<a>" * depth + b"</a>" * depth + b"</robot>")


def _whole_urdf(folder: Path, rng: Rng) -> None:
    whole = (BOMB, EXTERNAL, b"", b"<robot/>", b"\xff\xfe<\0r\0>\0", b"\x1f\x8b" + rng.bytes(500), b"<robot>" * 9)
    _urdf(folder).write_bytes(pick(rng, whole))


# Meshes, as vertices and faces.


def _vertices_mapped(folder: Path, rng: Rng) -> None:
    """The same faces over flattened, merged, tiny, huge, distant, noisy or not finite vertices."""
    path = _mesh(folder, rng)
    lines = path.read_bytes().split(b"\n")
    place = [n for n, line in enumerate(lines) if line.startswith(b"v ")]
    vertices = np.array([[float(word) for word in lines[n].split()[1:4]] for n in place])
    match int(rng.integers(10)):
        case 0:
            vertices[:, int(rng.integers(3))] = 0.0
        case 1:
            vertices[:, :2] = 0.5
        case 2:
            vertices[:] = vertices[0]
        case 3:
            vertices *= pick(rng, (1e-12, 1e-7, 1e-5, 1e-3, 12.0, 1e3, 1e5, 1e300))
        case 4:
            vertices += pick(rng, (5.0, 49.0, 1e4, 9e5))
        case 5:
            vertices[int(rng.integers(len(vertices)))] *= pick(rng, (30.0, 1e5, np.nan, np.inf))
        case 6:
            vertices = rng.normal(size=vertices.shape) * pick(rng, (1e-6, 1.0, 8.0))
        case 7:
            vertices[:, 0] = 1e-7 * rng.normal(size=len(vertices))
        case 8:
            vertices = np.round(vertices)
        case _:
            vertices = vertices[rng.permutation(len(vertices))]
    for n, vertex in zip(place, vertices, strict=True):
        lines[n] = b"v " + " ".join(f"{number:.9g}" for number in vertex).encode()
    path.write_bytes(b"\n".join(lines))


def _whole_mesh(folder: Path, rng: Rng) -> None:
    """A mesh of one triangle, of one point, of duplicates, of a giant polygon, of very many vertices."""
    triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
    many = int(pick(rng, (300, 20_000, 60_000)))
    ball = rng.normal(size=(many, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    sphere = "".join(f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in ball)
    whole = (
        triangle + "f 1 2 3\n",
        "v 0.1 0.1 0.1\nf 1 1 1\n",
        "v 0.1 0.1 0.1\n" * 9 + "f 1 2 3\nf 4 5 6\nf 7 8 9\n",
        triangle + "f 1 2 3\n" * many,
        sphere + "f 1 2 3\n",
        sphere + "f " + " ".join(str(k + 1) for k in range(many)) + "\n",
        triangle + "f -1 -2 -3\nf 3 2 1\n",
        "f 1 2 3\n" + triangle,
        triangle + "f 1 2 3\nf " + "1/" * many + "\n",
        triangle,
        "",
        triangle + "f 1 2 4294967299\n",
        triangle + "f 1 2 3" + " " * many + "\n",
        triangle + "v 0 0 1e-9\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n",
        "v 0 0 0\nv 0 0 0\nv 1 1 1\nv 1e-12 0 0\nf 1 2 3\nf 2 3 4\n",
        "call x.obj\n" + triangle + "f 1 2 3\n",
    )
    _mesh(folder, rng).write_text(pick(rng, whole))


# Other files, and files that are none.


def _strange_category(folder: Path, rng: Rng) -> None:
    value = pick(rng, CATEGORIES)
    _json(folder).write_bytes(value if rng.random() < 0.5 else b'{"model_cat": ' + value + b"}")


def _strange_semantics(folder: Path, rng: Rng) -> None:
    rows = (
        b"link_0 hinge " + b"x" * 99,
        b"a b",
        b"a b c d",
        b"\xff\xfe",
        b"link_0 hinge \xe2\x80\xae",
        b"x y z\n" * 9999,
    )
    (folder / "semantics.txt").write_bytes(pick(rng, rows))


def _no_file(folder: Path, rng: Rng) -> None:
    """A file that is gone, a folder, a pipe, or a link to elsewhere, to itself, or to something endless."""
    path = pick(rng, (_urdf(folder), _json(folder), folder / "semantics.txt", _mesh(folder, rng)))
    path.unlink()
    match int(rng.integers(7)):
        case 0:
            path.mkdir()
        case 1:
            os.mkfifo(path)
        case 2:
            path.symlink_to("/etc/passwd")
        case 3:
            path.symlink_to(path.name)
        case 4:
            path.symlink_to("/dev/zero")
        case 5:
            path.symlink_to(pick(rng, sorted(folder.rglob("*.obj")) or [folder]))


def _noise_in_other_files(folder: Path, rng: Rng) -> None:
    _noise(pick(rng, (_json(folder), folder / "semantics.txt")), rng)


def _on(find: Callable[[Path, Rng], Path], damage: Callable[[Path, Rng], None], name: str) -> Mutation:
    def mutation(folder: Path, rng: Rng) -> None:
        damage(find(folder, rng), rng)

    mutation.__name__ = name
    return mutation


_URDF: tuple[Mutation, ...] = (
    _on(lambda folder, _: _urdf(folder), _noise, "urdf_noise"),
    _on(lambda folder, _: _urdf(folder), _numbers, "urdf_numbers"),
    _on(lambda folder, _: _urdf(folder), _numbers, "urdf_numbers"),
    *map(
        _edited,
        (
            _remove,
            _duplicate,
            _move,
            _swap_attributes,
            _drop_attribute,
            _strange_attribute,
            _strange_path,
            _scale_meshes,
            _limits,
            _kinds_of_joints,
            _reconnect,
            _many,
        ),
    ),
    _deep_urdf,
    _whole_urdf,
)
_MESH: tuple[Mutation, ...] = (
    _on(_mesh, _noise, "mesh_noise"),
    _on(_mesh, _numbers, "mesh_numbers"),
    _vertices_mapped,
    _vertices_mapped,
    _whole_mesh,
)
_JSON: tuple[Mutation, ...] = (_on(lambda folder, _: _json(folder), _noise, "json_noise"), _strange_category)
_FILE: tuple[Mutation, ...] = (_no_file, _strange_semantics, _noise_in_other_files)
