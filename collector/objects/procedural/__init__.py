"""Procedural articulated objects in PartNet-Mobility's layout, for machines that have none of the real ones."""

from collector.objects.procedural.catalogue import CATEGORIES, EVERY_CATEGORY, build, categories_of, generate

__all__ = ["CATEGORIES", "EVERY_CATEGORY", "build", "categories_of", "generate"]
