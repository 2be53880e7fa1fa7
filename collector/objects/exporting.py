"""Exports objects as URDF and MJCF, with the very convex pieces that are simulated.

The URDF stands in our own layout, which `objects check` reads again; what other programs ask for beside it is added.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal
from xml.etree.ElementTree import Element, SubElement, fromstring, indent, tostring

import numpy as np

from collector.objects.articulation import ArticulatedObject
from collector.objects.model import MovablePart, ObjectModel, model_of, point
from collector.objects.partnet import URDF_FILE
from collector.objects.writing import (
    MESH_FOLDER,
    link_names,
    numbers_text,
    object_files,
    offset,
    parent_origins,
    write_folder,
)
from collector.sim.engine import cooked
from shared.io.files import remove_remnants, writing
from shared.types import Float

Format = Literal["urdf", "mjcf"]
MAIN_FILES: dict[Format, str] = {"urdf": URDF_FILE, "mjcf": "object.xml"}
MIN_INERTIA = 1e-8
"""kg times the square of a length, as in simulation."""
EFFORT, VELOCITY = 1e3, 1e2
"""What URDF wants for each joint; we limit neither."""


@dataclass(frozen=True, slots=True)
class Inertial:
    """Mass, centre [3] in the frame of the link, and moments [3, 3] about it."""

    mass: float
    centre: Float
    moments: Float


def export_object(target: ArticulatedObject, format: Format, folder: Path, part_mass: float) -> Path:
    """Write an object as a folder that other programs read.

    Args:
        target: with the pieces that it is simulated with.
        format: of the main file, which is `MAIN_FILES[format]` in the folder.
        folder: made; one that holds the same is left as it is.
        part_mass: kg, of each movable part.

    Returns:
        The main file.

    Raises:
        UsageError: the folder cannot be written, or holds something else.
    """
    model = simulated(target)
    inertials = [inertial(part, part_mass) for part in model.parts]
    files = object_files(model)
    urdf = fromstring(files.pop(URDF_FILE))  # noqa: S314 - our own.
    if format == "urdf":
        _complete(urdf, model, inertials)
        files[URDF_FILE] = _text(urdf)
    else:
        files[MAIN_FILES[format]] = _text(_mjcf(target.ref.id, model, inertials, files))
    with writing(folder, "name a folder that can"):
        folder.parent.mkdir(parents=True, exist_ok=True)
        remove_remnants(folder.parent)
        write_folder(folder, files)
    return folder / MAIN_FILES[format]


def simulated(target: ArticulatedObject) -> ObjectModel:
    """The model of an object whose collision meshes are the convex pieces that the engine makes of them."""
    bodies = [replace(body, collisions=tuple(filter(None, map(cooked, body.collisions)))) for body in target.bodies]
    return model_of(target.ref.category, bodies)


def inertial(part: MovablePart, mass: float) -> Inertial:
    """Mass, centre and moments of a part of uniform density, as in simulation; where pieces overlap, each counts."""
    pieces = part.pieces if part.collisions is None else part.collisions
    volume, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
    for piece in pieces:
        corners = (piece.vertices - np.array(part.origin))[piece.faces]
        volumes = np.linalg.det(corners) / 6.0
        sums = corners.sum(axis=1)
        volume += float(volumes.sum())
        first += volumes @ sums / 4.0
        # Of a tetrahedron with a corner at the origin: the integral of x x^T.
        products = np.einsum("fci,fcj->fij", corners, corners) + np.einsum("fi,fj->fij", sums, sums)
        second += np.einsum("f,fij->ij", volumes, products) / 20.0
    if not volume > 0:
        return Inertial(mass, np.zeros(3), np.eye(3) * mass * 1e-2)
    centre = first / volume
    about_centre = second / volume - np.outer(centre, centre)
    moments = mass * (np.trace(about_centre) * np.eye(3) - about_centre)
    return Inertial(mass, centre, moments + MIN_INERTIA * np.eye(3))


def _complete(robot: Element, model: ObjectModel, inertials: list[Inertial]) -> None:
    """Add what URDF wants beside what our layout says: inertias of the parts, effort and velocity of the joints."""
    links = {link.get("name"): link for link in robot.iter("link")}
    for name, each in zip(link_names(model)[1:], inertials, strict=True):
        element = Element("inertial")
        SubElement(element, "origin", xyz=numbers_text(point(each.centre)))
        SubElement(element, "mass", value=repr(each.mass))
        moments = {f"i{'xyz'[i]}{'xyz'[j]}": repr(float(each.moments[i, j])) for i in range(3) for j in range(i, 3)}
        SubElement(element, "inertia", moments)
        links[name].insert(0, element)
    for limit in robot.iter("limit"):
        limit.attrib |= {"effort": repr(EFFORT), "velocity": repr(VELOCITY)}


def _mjcf(name: str, model: ObjectModel, inertials: list[Inertial], files: dict[str, str]) -> Element:
    """The MJCF document of an object whose mesh files are among `files`."""
    top = Element("mujoco", model=name)
    SubElement(top, "compiler", angle="radian", autolimits="true", meshdir=MESH_FOLDER)
    assets = SubElement(top, "asset")
    for file in files:
        folder, _, mesh = file.partition("/")
        if folder == MESH_FOLDER:
            # What is seen need not enclose a volume, and has no mass here.
            SubElement(assets, "mesh", name=mesh.removesuffix(".obj"), file=mesh, inertia="shell")
    links, world = link_names(model), SubElement(top, "worldbody")
    bodies = [SubElement(world, "body", name=links[0])]
    _add_geoms(bodies[0], links[0], len(model.body), len(model.body_collisions or ()), numbers_text((0.0, 0.0, 0.0)))
    parents = parent_origins(model)
    for index, (part, each) in enumerate(zip(model.parts, inertials, strict=True)):
        parent = bodies[0 if part.parent is None else part.parent + 1]
        place = numbers_text(offset(part.origin, parents[index]))
        body = SubElement(parent, "body", name=links[index + 1], pos=place)
        bodies.append(body)
        m = each.moments
        full = numbers_text(tuple(float(m[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))))
        SubElement(body, "inertial", pos=numbers_text(point(each.centre)), mass=repr(each.mass), fullinertia=full)
        kind = "slide" if part.kind == "prismatic" else "hinge"
        limits = numbers_text((part.lower, part.upper))
        SubElement(
            body, "joint", name=f"joint_{index}", type=kind, axis=numbers_text(part.axis), range=limits, limited="true"
        )
        shift = numbers_text(offset((0.0, 0.0, 0.0), part.origin))
        _add_geoms(body, links[index + 1], len(part.pieces), len(part.collisions or ()), shift)
    return top


def _add_geoms(body: Element, link: str, seen: int, hit: int, shift: str) -> None:
    """The geoms of a body; what is seen is in group 2 and touches nothing, what collides is in group 3, as is usual."""
    for number in range(seen):
        SubElement(
            body,
            "geom",
            {
                "type": "mesh",
                "mesh": f"{link}-{number}",
                "pos": shift,
                "contype": "0",
                "conaffinity": "0",
                "group": "2",
            },
        )
    for number in range(hit):
        SubElement(body, "geom", {"type": "mesh", "mesh": f"{link}-collision-{number}", "pos": shift, "group": "3"})


def _text(top: Element) -> str:
    indent(top, space="  ")
    return '<?xml version="1.0"?>\n' + tostring(top, encoding="unicode") + "\n"
