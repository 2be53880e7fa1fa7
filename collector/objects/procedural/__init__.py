"""Procedural articulated objects in PartNet-Mobility's layout, for machines that have none of the real ones."""

from collector.objects.procedural.catalogue import CATEGORIES, build
from collector.objects.procedural.writing import generate

__all__ = ["CATEGORIES", "build", "generate"]
